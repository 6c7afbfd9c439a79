"""Compression of baked assets: the smallest form that meets an error, measured on the decoded coefficients."""

import dataclasses
import math
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from bakers.compression import Trial, candidate_bases, identity_bases, quantised, tried_bases
from bakers.error_covariance import added_covariance, clustered, error_sums
from formats.asset import Asset, read_asset
from formats.asset.compact_file import SparseCodes, join_sparse, round_up, to_sparse, write_compact
from formats.asset.compact_record import AddedError, CompactCoefficients
from formats.asset.error_covariance import ErrorCovariance, pairs
from formats.atomic import replacing
from formats.errors import AssetError, QueryError, refuse_path
from prt_bake.mathematics import sphere
from prt_bake.mathematics.view_frames import ViewFrames
from prt_bake.shading.reconstruction import reconstruct

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

LEAST_ERROR = 1e-6
SAMPLE_BYTES = 2**28
"""Size of the sample of coefficients to which forms are fitted."""
SINGLE_PRECISION = 1e-3
"""Smallest error for which float32 is exact enough for products with bases."""
LEAST_SAMPLE = 64
"""Fewest vertices of the sample."""
AT_ONCE, _AROUND = 64, 8
_PASSES = 6


class Tried(NamedTuple):
    """Result of a form on the sample: predicted bytes of all vertices, the added error, and seconds."""

    form: str
    size: int
    error: float
    seconds: float


class Outcome(NamedTuple):
    """Result of compressing a file. If the compact form is not smaller, the file is a copy and `compact` is None.

    raw: bytes in float32. before, after: bytes of the coefficients and their errors in the files.
    """

    asset: Asset
    compact: CompactCoefficients | None
    raw: int
    before: int
    after: int
    seconds: float


class Encoded(NamedTuple):
    """All vertices in one form: parts of the compact codes, squares of the error [V] and of the original [V], and sums
    of products of the errors of two harmonics [V,P], and of each channel [V,C].
    """

    parts: list[SparseCodes]
    lost: Array
    original: Array
    covariance: Array
    of_channels: Array


def compress(asset: Asset, error: float, progress: Progress | None = None) -> Asset:
    """The asset with compact coefficients whose added relative RMSE is at most `error`.

    The error is ‖decoded − original‖ / ‖original‖ over valid vertices, view bins, harmonics and channels.
    `standard_error` becomes [V,1]: the root of the mean square of the original's over bins plus the square of the added
    error. The provenance gets a table "compression": bytes before, forms tried, seconds.

    Raises QueryError for an error below 10⁻⁶ or from 1 on, and for an asset that is compact already.

    Example:
        >>> import numpy as np, prt_bake as prt, trimesh
        >>> class Matte:
        ...     def evaluate(self, incident, positions, outgoing):
        ...         cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        ...         return np.repeat(cosine[..., None] / np.pi, 3, axis=-1)
        >>> sphere = trimesh.creation.icosphere(subdivisions=0)
        >>> mesh = prt.Mesh(sphere.vertices, sphere.faces.astype(np.int32), sphere.vertex_normals)
        >>> asset = prt.bake(Matte(), mesh, degree=1, rings=1, sectors=4)
        >>> compact = prt.compress(asset, error=0.01)
        >>> bool(compact.coefficients.added.total <= 0.01)
        True
    """
    refuse_path("asset", asset, "prt.read_asset")
    if not LEAST_ERROR <= error < 1.0:
        raise QueryError(f"error: must be a relative RMSE from {LEAST_ERROR:g} to below 1, found {error:g}")
    if isinstance(asset.coefficients, CompactCoefficients):
        raise QueryError("asset: is compact already; compress the asset that it was made from")
    began = time.monotonic()
    report = progress or (lambda share, words: None)
    sample = _sample(asset, SAMPLE_BYTES // np.dtype(product_dtype(error)).itemsize)
    squares = float(np.square(sample, dtype=np.float64).sum())
    trials, table = _trials(asset, sample, error**2 * squares, error, squares, report)
    share = int(np.count_nonzero(asset.valid)) / max(1, len(sample))
    if not trials:
        trials.append(_untransformed(asset, error))
    best = min(trials, key=lambda trial: share * trial.size + trial.basis)
    table += [*_trade(best, sample, error, squares, share)]
    del sample
    found = _within(asset, best, error, report)
    if found is None:  # vertices outside the sample differ from all vertices in it
        best = _untransformed(asset, error)
        found = _within(asset, best, error, report)
    if found is None:
        raise QueryError(f"error: {error:g} is smaller than codes of 32 bits can represent; request a larger error")
    compact, encoded = found
    own = np.square(np.asarray(asset.standard_error, np.float64)).mean(axis=1)
    stated = np.where(asset.valid, np.sqrt(own + np.square(compact.added.per_vertex, dtype=np.float64)), 0.0)
    noise = float(own[asset.valid].sum()) * math.prod(asset.coefficients.shape[1:])
    original = float(encoded.original.sum())
    record = {
        "form": best.bases.name,
        "components": len(compact.view_component),
        "codes_that_are_not_zero": len(compact.values),
        "raw_float32_bytes": raw_bytes(asset),
        "bytes_before": stored_bytes(asset),
        "standard_error_before": math.sqrt(noise / original) if original > 0.0 else 0.0,
        "tried": [row._asdict() for row in table],
        "seconds": round(time.monotonic() - began, 2),
    }
    return dataclasses.replace(
        asset,
        coefficients=compact,
        standard_error=round_up(stated[:, None]),
        storage="float32",
        error_covariance=_error_covariance(asset, own, encoded),
        selftest=_selftest(asset, compact),
        provenance={**asset.provenance, "compression": record},
    )


def compress_file(
    path: str | Path, out: str | Path, error: float, progress: Progress | None = None, command: str | None = None
) -> Outcome:
    """Reads an asset and writes it compact, or copies it to `out` if the compact form is not smaller.

    Raises as `read_asset`, `compress` and `write_asset` do, and QueryError if `out` is the asset itself.
    """
    if Path(out).exists() and Path(out).samefile(path):
        raise QueryError(f"{out}: is the asset itself; give another name, because the compact asset loses information")
    began = time.monotonic()
    asset = read_asset(path, load=False)
    try:
        if isinstance(asset.coefficients, CompactCoefficients):
            raise QueryError(f"{path}: is compact already; compress the asset that it was made from")
        raw, before = raw_bytes(asset), stored_bytes(asset)
        made = compress(asset, error, progress)
    finally:
        asset.close()
    made.provenance["compression"]["command"] = command
    after = write_compact(made, out)
    if after < before:
        return Outcome(made, made.coefficients, raw, before, after, time.monotonic() - began)
    with replacing(out) as part:
        shutil.copyfile(path, part)
    return Outcome(asset, None, raw, before, before, time.monotonic() - began)


def unpacked(asset: Asset) -> Asset:
    """The asset with its coefficients as a float32 array; itself if it is not compact.

    Example:
        >>> import numpy as np, prt_bake as prt, trimesh
        >>> class White:
        ...     def evaluate(self, incident, positions, outgoing):
        ...         return np.ones((*incident.shape[:-1], 3))
        >>> sphere = trimesh.creation.icosphere(subdivisions=0)
        >>> mesh = prt.Mesh(sphere.vertices, sphere.faces.astype(np.int32), sphere.vertex_normals)
        >>> asset = prt.bake(White(), mesh, degree=1, rings=1, sectors=4)
        >>> prt.unpacked(prt.compress(asset, error=0.01)).coefficients.shape
        (12, 4, 4, 3)
    """
    if not isinstance(asset.coefficients, CompactCoefficients):
        return asset
    return dataclasses.replace(asset, coefficients=asset.coefficients[:])


def stored_bytes(asset: Asset) -> int:
    """Bytes of the coefficients and their errors in the asset's file, or of the arrays in memory."""
    if isinstance(asset.coefficients, h5py.Dataset):
        group = asset.coefficients.parent
        return sum(int(group[name].id.get_storage_size()) for name in group)
    return int(math.prod(asset.coefficients.shape) * asset.coefficients.dtype.itemsize + asset.standard_error.nbytes)


def raw_bytes(asset: Asset) -> int:
    """Bytes of the coefficients in float32, without pruned axes."""
    return 4 * int(math.prod(asset.coefficients.shape))


def product_dtype(error: float) -> Any:
    """The dtype in which products of coefficients and bases are exact enough for the error."""
    return np.float32 if error >= SINGLE_PRECISION else np.float64


def _sample(asset: Asset, numbers: int) -> NDArray[np.float32]:
    """Coefficients of evenly spaced valid vertices, about `numbers` in total."""
    shape = asset.coefficients.shape
    valid = np.flatnonzero(asset.valid)
    if not len(valid):
        raise QueryError("asset: expected at least one valid vertex, found none; bake it again")
    count = min(len(valid), max(LEAST_SAMPLE, numbers // math.prod(shape[1:])))
    chosen = valid[np.linspace(0, len(valid) - 1, count).round().astype(np.int64)]
    return np.concatenate([_read(asset, chosen[i : i + AT_ONCE]) for i in range(0, count, AT_ONCE)])


def _read(asset: Asset, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Coefficients of vertices in ascending order, 0 for those that are not valid."""
    span = _stored(asset, int(rows[0]), int(rows[-1]) + 1)
    block = np.where(asset.valid[rows, None, None, None], span[rows - rows[0]], 0.0).astype(np.float32)
    wrong = ~np.isfinite(block).all(axis=(1, 2, 3))
    if wrong.any():
        raise QueryError(f"asset: coefficients of vertex {rows[wrong.argmax()]} are not finite; bake it again")
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


def _trials(
    asset: Asset, sample: NDArray[np.float32], allowed: float, error: float, squares: float, report: Progress
) -> tuple[list[Trial], list[Tried]]:
    share = int(np.count_nonzero(asset.valid)) / len(sample)
    trials: list[Trial] = []
    table: list[Tried] = []
    for bases in candidate_bases(sample, asset.rings, asset.sectors, allowed):
        report(0.1 + 0.1 * len(table), f"trying {bases.name}")
        began = time.monotonic()
        trial = tried_bases(bases, sample, allowed, product_dtype(error))
        if trial is None:
            continue
        trials.append(trial)
        table.append(_row(trial, share, squares, time.monotonic() - began))
    return trials, table


def _trade(best: Trial, sample: NDArray[np.float32], error: float, squares: float, share: float) -> Iterator[Tried]:
    """Results of the chosen form at half, twice and four times the error."""
    for factor in (0.5, 2.0, 4.0):
        if factor * error < 1.0:
            began = time.monotonic()
            trial = tried_bases(best.bases, sample, (factor * error) ** 2 * squares, product_dtype(factor * error))
            if trial is not None:
                yield _row(trial, share, squares, time.monotonic() - began)


def _row(trial: Trial, share: float, squares: float, seconds: float) -> Tried:
    error = math.sqrt(trial.squares / squares) if squares > 0.0 else 0.0
    return Tried(trial.bases.name, round(share * trial.size) + trial.basis, error, round(seconds, 2))


def _error_covariance(asset: Asset, own: Array, encoded: Encoded) -> ErrorCovariance | None:
    """Error covariance after compression: that of the bake, with mean variance `own` [V], plus that of the codes."""
    if asset.error_covariance is None:
        return None
    _, bins, terms, channels = asset.coefficients.shape
    sums = encoded.covariance / (bins * channels), encoded.of_channels / (bins * terms)
    whole = added_covariance(asset.error_covariance.at_vertices(np.arange(len(own))), own, *sums)
    return clustered(whole, np.where(asset.valid, own + sums[1].mean(axis=1), 0.0))


def _within(asset: Asset, trial: Trial, error: float, report: Progress) -> tuple[CompactCoefficients, Encoded] | None:
    """All vertices in the form, with smaller quantisation steps until the error is met; None if the components that the
    form omits exceed the error.
    """
    step = trial.step
    for attempt in range(_PASSES):
        encoded = _encoded(asset, trial, step, error, lambda done: report(0.5 + 0.5 * done, "encoding"))
        lost, original = float(encoded.lost.sum()), float(encoded.original.sum())
        if lost <= error**2 * original:
            return _compact(asset, trial, step, error, encoded), encoded
        step *= 0.998 * (error**2 * original / lost) ** (1.0 + attempt)
    return None


def _untransformed(asset: Asset, error: float) -> Trial:
    """Coefficients without a transform, with a step that meets the error for any distribution."""
    _, bins, terms, channels = asset.coefficients.shape
    rings, sectors = (asset.rings, asset.sectors) if bins > 1 else (1, 1)
    squares = count = 0.0
    for first in range(0, len(asset.valid), AT_ONCE):
        rows = np.arange(first, min(first + AT_ONCE, len(asset.valid)))
        squares += float(np.square(_read(asset, rows), dtype=np.float64).sum())
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
        block = _read(asset, rows)
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


def _selftest(asset: Asset, compact: CompactCoefficients) -> dict[str, NDArray[Any]]:
    """The original's selftest with the radiance of the compact coefficients."""
    if not asset.selftest:
        return {}
    vertices = np.asarray(asset.selftest["vertex"], np.int64)
    tangents = np.asarray(asset.tangents, np.float64)[vertices]
    local = sphere.to_local(asset.selftest["outgoing"], asset.mesh.normals[vertices], tangents)
    at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    light = np.asarray(asset.selftest["light"], np.float64) if asset.quantity == "transfer" else np.ones((1, 3))
    return {**asset.selftest, "radiance": reconstruct(compact, vertices, at, asset.sectors, light)}
