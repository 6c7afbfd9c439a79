"""Compression of baked assets: the smallest form that meets an error, measured on the decoded coefficients."""

import dataclasses
import math
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from bakers.compression import Trial, candidate_bases, tried_bases
from bakers.error_covariance import added_covariance, clustered
from formats.asset import Asset, read_asset
from formats.asset.compact_file import round_up, write_compact
from formats.asset.compact_record import CompactCoefficients
from formats.asset.error_covariance import ErrorCovariance
from formats.asset.lobes import add_lobes_to_file
from formats.atomic import replacing
from formats.errors import QueryError, refuse_path
from prt_bake.baking.compact_encoding import (
    AT_ONCE,
    Encoded,
    Progress,
    encoded_within,
    product_dtype,
    read_valid,
    untransformed,
)
from prt_bake.lobes.rounding import rounded
from prt_bake.lobes.selftest import with_lobes
from prt_bake.shading.selftest import selftest_radiance, warn_of_failed_selftest

Array = NDArray[np.float64]

LEAST_ERROR = 1e-6
ERROR_OF_LOBES = 2.0
"""Error that rounding the lobes may add, in errors of the coefficients."""
_LEFT_OUT = {"lobes_in_a_view": 0, "reason": "left out when the asset was compressed"}
SAMPLE_BYTES = 2**28
"""Size of the sample of coefficients to which forms are fitted."""
LEAST_SAMPLE = 64
"""Fewest vertices of the sample."""


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


def compress(asset: Asset, error: float, progress: Progress | None = None) -> Asset:
    """The asset with compact coefficients whose added relative RMSE is at most `error`, and lobes of fewer digits.

    The error is ‖decoded − original‖ / ‖original‖ over valid vertices, view bins, harmonics and channels. Rounding the
    lobes adds at most twice as much: they are more numbers, and approximations themselves.
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
        trials.append(untransformed(asset, error))
    best = min(trials, key=lambda trial: share * trial.size + trial.basis)
    table += [*_trade(best, sample, error, squares, share)]
    del sample
    found = encoded_within(asset, best, error, report)
    if found is None:  # vertices outside the sample differ from all vertices in it
        best = untransformed(asset, error)
        found = encoded_within(asset, best, error, report)
    if found is None:
        raise QueryError(f"error: {error:g} is smaller than codes of 32 bits can represent; request a larger error")
    compact, encoded = found
    own = np.square(np.asarray(asset.standard_error, np.float64)).mean(axis=1)
    stated = np.where(asset.valid, np.sqrt(own + np.square(compact.added.per_vertex, dtype=np.float64)), 0.0)
    _, bins, terms, channels = asset.coefficients.shape
    noise = float(own[asset.valid].sum()) * bins * terms * channels
    original = float(encoded.original.sum())
    record = {
        "form": best.bases.name,
        "components": len(compact.view_component),
        "codes_that_are_not_zero": len(compact.values),
        "raw_float32_bytes": raw_bytes(asset),
        "bytes_before": stored_bytes(asset),
        "added_relative_rmse": compact.added.total,
        "standard_error_before": math.sqrt(noise / original) if original > 0.0 else 0.0,
        "tried": [row._asdict() for row in table],
        "seconds": round(time.monotonic() - began, 2),
    }
    lobes = asset.lobes
    if lobes is not None and original > 0.0:
        # Harmonics are orthonormal: their squares over a bin are those of the transport over the sphere.
        norm = math.sqrt(original * 3.0 / channels * lobes.rings * lobes.sectors / bins)
        lobes, changed = rounded(lobes, ERROR_OF_LOBES * error * norm)
        record["lobes_error"] = changed / norm
    made = dataclasses.replace(
        asset,
        coefficients=compact,
        standard_error=round_up(stated[:, None]),
        storage="float32",
        error_covariance=_error_covariance(asset, own, encoded),
        provenance={**asset.provenance, "compression": record},
    )
    if made.selftest:
        made = dataclasses.replace(made, selftest={**made.selftest, "radiance": selftest_radiance(made)})
    return with_lobes(made, lobes)


def compress_file(
    path: str | Path,
    out: str | Path,
    error: float,
    progress: Progress | None = None,
    command: str | None = None,
    lobes: bool = True,
) -> Outcome:
    """Reads an asset and writes it compact, or copies it to `out` if the compact form is not smaller.

    lobes: keep those of the asset, with fewer digits.

    Raises as `read_asset`, `compress` and `write_asset` do, and QueryError if `out` is the asset itself.
    """
    if Path(out).exists() and Path(out).samefile(path):
        raise QueryError(f"{out}: is the asset itself; give another name, because the compact asset loses information")
    began = time.monotonic()
    asset = read_asset(path, load=False)
    try:
        if isinstance(asset.coefficients, CompactCoefficients):
            raise QueryError(f"{path}: is compact already; compress the asset that it was made from")
        warn_of_failed_selftest(asset, path)
        raw, before = raw_bytes(asset), stored_bytes(asset)
        made = compress(asset if lobes else without_lobes(asset), error, progress)
    finally:
        asset.close()
    made.provenance["compression"]["command"] = command
    after = write_compact(made, out)
    if after < before:
        return Outcome(made, made.coefficients, raw, before, after, time.monotonic() - began)
    if lobes:
        with replacing(out) as part:
            shutil.copyfile(path, part)
    else:
        add_lobes_to_file(path, out, None, {"lobes": _LEFT_OUT}, without_lobes(asset).selftest)
    return Outcome(asset, None, raw, before, before, time.monotonic() - began)


def without_lobes(asset: Asset) -> Asset:
    """The asset without its lobes; itself if it has none."""
    if asset.lobes is None:
        return asset
    return with_lobes(dataclasses.replace(asset, provenance={**asset.provenance, "lobes": _LEFT_OUT}), None)


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


def _sample(asset: Asset, numbers: int) -> NDArray[np.float32]:
    """Coefficients of evenly spaced valid vertices, about `numbers` in total."""
    shape = asset.coefficients.shape
    valid = np.flatnonzero(asset.valid)
    if not len(valid):
        raise QueryError("asset: expected at least one valid vertex, found none; bake it again")
    count = min(len(valid), max(LEAST_SAMPLE, numbers // math.prod(shape[1:])))
    chosen = valid[np.linspace(0, len(valid) - 1, count).round().astype(np.int64)]
    return np.concatenate([read_valid(asset, chosen[i : i + AT_ONCE]) for i in range(0, count, AT_ONCE)])


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
