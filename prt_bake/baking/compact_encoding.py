"""Encodes all vertices of an asset in a compact form, with the quantisation step that meets the error."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from bakers.compression import Trial, identity_bases, quantised
from bakers.error_covariance import error_sums
from formats.asset import Asset
from formats.asset.compact_file import SparseCodes, join_sparse, round_up, to_sparse
from formats.asset.compact_record import AddedError, CompactCoefficients
from formats.asset.error_covariance import pairs
from formats.errors import AssetError, QueryError
from prt_bake.mathematics import sphere
from prt_bake.mathematics.view_frames import ViewFrames

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

SINGLE_PRECISION = 1e-3
"""Smallest error for which float32 is exact enough for products with bases."""
LARGEST = 1e15
"""Largest coefficient that is compressed: sums of squares over 64 vertices, their bins and harmonics fit float32."""
AT_ONCE, _AROUND = 64, 8
_PASSES = 6


class Encoded(NamedTuple):
    """All vertices in one form: parts of the compact codes, squares of the error [V] and of the original [V], and sums
    of products of the errors of two harmonics [V,P], and of each channel [V,C].
    """

    parts: list[SparseCodes]
    lost: Array
    original: Array
    covariance: Array
    of_channels: Array


def encoded_within(
    asset: Asset, trial: Trial, error: float, report: Progress
) -> tuple[CompactCoefficients, Encoded] | None:
    """All vertices in the form, with smaller quantisation steps until the error is met; None if the components that the
    form omits exceed the error.
    """
    step = trial.step
    left = 0.5
    for attempt in range(_PASSES):
        text = "encoding" if attempt == 0 else "encoding again, in finer steps"
        # Another attempt may follow: each is half of what is left, so that the share never decreases.
        encoded = _encoded(asset, trial, step, error, _within(report, 1.0 - left, left / 2.0, text))
        left /= 2.0
        lost, original = float(encoded.lost.sum()), float(encoded.original.sum())
        if lost <= error**2 * original:
            return _compact(asset, trial, step, error, encoded), encoded
        step *= 0.998 * (error**2 * original / lost) ** (1.0 + attempt)
    return None


def _within(report: Progress, first: float, share: float, text: str) -> Callable[[float], None]:
    return lambda done: report(first + share * done, text)


def untransformed(asset: Asset, error: float) -> Trial:
    """Coefficients without a transform, with a step that meets the error for any distribution."""
    _, bins, terms, channels = asset.coefficients.shape
    rings, sectors = (asset.rings, asset.sectors) if bins > 1 else (1, 1)
    squares = count = 0.0
    for first in range(0, len(asset.valid), AT_ONCE):
        rows = np.arange(first, min(first + AT_ONCE, len(asset.valid)))
        squares += float(np.square(read_valid(asset, rows), dtype=np.float64).sum())
        count += float(asset.valid[rows].sum()) * bins * terms * channels
    bases = identity_bases(rings, sectors, terms, channels)
    channel, view = (part.ravel() for part in np.mgrid[: terms * channels, :bins])
    return Trial(bases, view, channel, error * math.sqrt(2.0 * squares / count) or 1.0, 0.0, 0, 0)


def _encoded(asset: Asset, trial: Trial, step: float, error: float, report: Callable[[float], None]) -> Encoded:
    kind = product_dtype(error)
    bases = trial.bases
    analysis = bases.analysis(kind)
    at = trial.view_component, trial.channel_component
    views, channels = bases.views.matrix.T.astype(kind), bases.channels.reshape(len(bases.channels), -1).astype(kind)
    vertices, (terms, colours) = len(asset.valid), asset.coefficients.shape[2:]
    parts, lost, original = [], np.zeros(vertices), np.zeros(vertices)
    covariance, of_channels = np.zeros((vertices, pairs(terms))), np.zeros((vertices, colours))
    for first in range(0, vertices, AT_ONCE):
        rows = np.arange(first, min(first + AT_ONCE, vertices))
        if not asset.valid[rows].any():
            parts.append(to_sparse(np.zeros((1, len(rows)), np.int32)))
            continue
        block = read_valid(asset, rows)
        numbers = bases.components(block, analysis)
        codes = quantised(numbers[:, at[0], at[1]].T.astype(np.float64), step)
        parts.append(to_sparse(codes))
        numbers[:] = 0.0
        numbers[:, at[0], at[1]] = codes.T * step
        decoded = np.matmul(views, numbers @ channels)
        flat = block.reshape(decoded.shape)
        errors = decoded - flat
        if asset.error_covariance is not None:
            covariance[rows], of_channels[rows] = _covariance_sums(asset, rows, errors.reshape(block.shape))
        lost[rows] = np.square(errors, dtype=np.float64).sum(axis=(1, 2))
        original[rows] = np.square(flat, dtype=np.float64).sum(axis=(1, 2))
        report((first + len(rows)) / vertices)
    return Encoded(parts, lost, original, covariance, of_channels)


def _covariance_sums(asset: Asset, vertices: NDArray[np.int64], errors: NDArray[np.floating]) -> tuple[Array, Array]:
    """Sums [n,P], [n,C] for the covariance of errors [n,B,K,C] of these vertices, in the view frames."""
    n, bins, terms, channels = errors.shape
    normals, tangents = (np.asarray(each, np.float64) for each in (asset.mesh.normals, asset.tangents))
    frames = ViewFrames(normals, tangents)
    # A single view represents views all around.
    local = asset.directions if bins == len(asset.directions) else sphere.view_bins(1, _AROUND)
    outgoing = sphere.to_world(local, normals[vertices, None], tangents[vertices, None])
    views = outgoing.shape[1]
    each = np.broadcast_to(errors, (n, views, terms, channels)).astype(np.float64)
    each = each.reshape(n * views, terms, channels)
    in_view = frames.in_view(np.repeat(vertices, views), outgoing.reshape(-1, 3), each)
    covariance, of_channels = error_sums(in_view.reshape(n, views, terms, channels), channels)
    return covariance * (bins / views), of_channels * (bins / views)


def _compact(asset: Asset, trial: Trial, step: float, error: float, encoded: Encoded) -> CompactCoefficients:
    lost, original, valid = encoded.lost, encoded.original, np.asarray(asset.valid, np.bool_)
    ratios = np.sqrt(lost[valid] / np.where(original[valid] > 0.0, original[valid], 1.0))
    starts, components, values = join_sparse(encoded.parts, len(trial.view_component))
    total = float(original.sum())
    return CompactCoefficients(
        step=step,
        views=trial.bases.views,
        channels=trial.bases.channels,
        view_component=trial.view_component,
        channel_component=trial.channel_component,
        starts=starts,
        components=components,
        values=values,
        added=AddedError(
            requested=error,
            total=math.sqrt(float(lost.sum()) / total) if total > 0.0 else 0.0,
            percentile_95=float(np.percentile(ratios, 95)),
            worst=float(ratios.max()),
            per_vertex=round_up(np.sqrt(lost / math.prod(asset.coefficients.shape[1:]))),
        ),
    )


def read_valid(asset: Asset, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Coefficients of vertices in ascending order, 0 for those that are not valid."""
    span = _stored(asset, int(rows[0]), int(rows[-1]) + 1)
    block = np.where(asset.valid[rows, None, None, None], span[rows - rows[0]], 0.0).astype(np.float32)
    wrong = ~np.isfinite(block).all(axis=(1, 2, 3))
    if wrong.any():
        raise QueryError(f"asset: coefficients of vertex {rows[wrong.argmax()]} are not finite; bake it again")
    largest = np.abs(block).max(axis=(1, 2, 3), initial=0.0)
    if (largest > LARGEST).any():
        raise QueryError(
            f"asset: expected coefficients within ±{LARGEST:g}, whose products float32 holds, found "
            f"{largest.max():.4g} at vertex {rows[largest.argmax()]}; scale the transport"
        )
    return block


def _stored(asset: Asset, start: int, stop: int) -> NDArray[np.floating]:
    """Coefficients of some vertices; raises AssetError that names the file if it is damaged there."""
    try:
        return np.asarray(asset.coefficients[start:stop])
    except OSError as cause:
        if cause.errno is not None or not isinstance(asset.coefficients, h5py.Dataset):
            raise
        raise AssetError(
            f"{asset.coefficients.file.filename}: is damaged: the coefficients of vertices {start} to {stop - 1} "
            "cannot be decompressed; copy or bake it again"
        ) from cause


def product_dtype(error: float) -> Any:
    """The dtype in which products of coefficients and bases are exact enough for the error."""
    return np.float32 if error >= SINGLE_PRECISION else np.float64
