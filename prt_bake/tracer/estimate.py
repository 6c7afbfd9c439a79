"""Estimates of the transport function Ŝ and of its harmonic coefficients, with standard errors.

A query is a point x on the surface and a direction ωo to the eye. `estimate_transport` estimates Ŝ(ωi; x, ωo) [1/sr]
for given directions of incidence, `estimate_coefficients` estimates a_lm = ∫ Ŝ Y_lm dωi from the exits of walks.
Both include every path whose first event at x, seen from the eye, is the transmission into the object. Light that then
crosses an index-matched or smooth object without scattering is a delta function, reported separately as unscattered.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from formats.scene import Scene
from formats.summary import summary
from prt_bake.jit.threads import in_threads
from prt_bake.mathematics.moments import SUMS, Moments, from_sums, merged
from prt_bake.tracer.gpu.availability import require_walks_on
from prt_bake.tracer.prepared import (
    KernelQueries,
    PreparedScene,
    has_dielectric_inside,
    no_values_reason,
    prepare,
    rough_parts,
)
from prt_bake.tracer.surface.boundary import SMOOTHEST
from prt_bake.tracer.volume.media import PHASE_G

Array = NDArray[np.float64]

_PATHS_PER_CHUNK = 2048
_NUMBERS_AT_ONCE = 4_000_000
_KURTOSIS_PER_PATH = 1 / 5
"""An estimate is reliable if the kurtosis of its sample is below this share of the number of paths. A stricter limit
would do harm: among samples near the limit it prefers those that missed the strong paths."""
_LEAST_PATHS = 64
"""Paths required if no connection exceeds an isotropic one. Others require `_sharpness` times as many: their strong
paths are as rare as they are strong, and a sample that missed them all looks perfect."""
_REFRACTED_INSIDE = 4.0
"""Further factor if a dielectric inside refracts light (measured on a drink with ice at alpha 0.05: bounds cover 86 %
with 80 alpha⁻² paths, 93.5 % with 160, 95 % with 330)."""
_DARK = 1e-3 / (4.0 * math.pi)
"""[1/sr]: a thousandth of isotropic transport. For values that are certainly darker an upper bound suffices."""
_RULE_OF_THREE = 3.0
"""A sample of n paths misses an event of probability 3 / n in 5 of 100 cases."""
_BRIGHT = 1.0 / math.pi
"""[1/sr]: contribution of a walk that reaches the light, that of a white diffuse surface. Sharp lobes concentrate it in
fewer, stronger paths. Next-event estimation finds most of these; the rest count with `_MISSED` of the sharpness."""
_MISSED = 0.1
_CONNECTIONS = 8
_BOUND = 1.96
_ROUNDING = 1e-14
"""Walks that differ by less than this, relative to their mean, carry the same."""
_TINY_VARIANCE = 1e-140
"""Below this, fourth powers underflow and the kurtosis is set to infinity."""


@dataclass(frozen=True)
class Estimate:
    """Mean and one-sigma standard error of N queries, and how far to trust them.

    Attributes:
        mean, standard_error: [N,3] or [N,D,3] (Ŝ, 1/sr) or [N,K,3] (coefficients). mean ± 1.96 standard_error covers
            the truth in 95 of 100 cases if the query is `reliable`; the error includes a correction for the skewness of
            the sample. Values of Ŝ that are certainly below 8e-5 1/sr (a thousandth of isotropic transport) and rest on
            too few strong paths, or on none, get a wider bound: it adds the contribution that unsampled paths may have,
            3 / paths times that of a strong path.
        unscattered: [N], or [N,3] if extinction differs between channels: transmittance of light that crosses the
            object without a scattering event. This light is a delta function and is not in `mean`. Behind a rough
            interface it is a function, which `mean` includes, and `unscattered` is 0.
        reliable: [N], False if the error bars cannot be trusted at this number of paths. It requires 64 paths, times
            the peak of the interface's lobe (averaged over a texture) or of the phase function relative to an isotropic
            one, times four if a dielectric inside refracts light. Each value also requires either that some path
            contributes and the kurtosis of the sample is below a fifth of the paths, or that the upper bound shows it
            to be dark.
        lost: [N], mean throughput of truncated walks (0 unless a walk exceeds ten million events).
        paths, seconds: walks per query, and total wall time.
    """

    mean: Array
    standard_error: Array
    unscattered: Array
    reliable: NDArray[np.bool_]
    lost: Array
    paths: int
    seconds: float

    __repr__ = summary


def estimate_transport(
    scene: Scene,
    positions: ArrayLike,
    outgoing: ArrayLike,
    incident: ArrayLike,
    paths: int = 1024,
    seed: int = 0,
    *,
    connections: int = _CONNECTIONS,
) -> Estimate:
    """Estimate Ŝ(ωi; x, ωo) [1/sr] at positions [N,3] on the surface for outgoing [N,3] and incident [N,3] or [N,D,3].

    One walk serves all D directions of its query. Each event of a walk connects to `connections` of them; the
    expectation does not depend on it. The random numbers depend on the seed, the index of the query and the path alone.

    Raises QueryError for wrong shapes, directions that are not of unit length, positions off the surface, queries below
    the horizon, and smooth interfaces, behind which Ŝ is a sum of delta functions that no connection samples.

    >>> import prt_bake as prt
    >>> scene = prt.load_scene("spot.toml")
    >>> x, n = scene.mesh.positions[:1], scene.mesh.normals[:1]
    >>> prt.estimate_transport(scene, x, n, n, paths=64).mean.shape
    (1, 3)
    """
    prepared = prepare(scene)
    if reason := no_values_reason(scene):
        raise QueryError(
            f"{scene.path}: {reason}; no event can connect to a given direction of incidence there; use "
            "estimate_coefficients"
        )
    directions = _directions(incident, "incident")
    single = directions.ndim == 2
    directions = np.ascontiguousarray(directions[:, None] if single else directions)
    queries = _place(prepared, positions, outgoing)
    if len(directions) != len(queries.keys):
        raise QueryError(
            f"incident: expected shape [{len(queries.keys)},3] or [{len(queries.keys)},D,3], found {np.shape(incident)}"
        )

    def run(chosen: slice, chunks: NDArray[np.int64], sums: Array) -> None:
        from prt_bake.tracer.kernels import sum_transport

        in_threads(
            sum_transport,
            len(chunks),
            prepared.boundary,
            prepared.medium,
            queries.rows(chosen),
            chunks,
            directions[chosen],
            connections,
            prepared.next_event,
            seed,
            sums,
        )

    shape = () if single else directions.shape[1:2]
    sharpness = _sharpness(scene, prepared)
    strong = _BRIGHT * max(1.0, _MISSED * sharpness)
    return _estimate(run, len(queries.keys), paths, shape, directions.shape[1], _LEAST_PATHS * sharpness, strong)


def estimate_coefficients(
    scene: Scene,
    positions: ArrayLike,
    outgoing: ArrayLike,
    degree: int = 2,
    paths: int = 1024,
    seed: int = 0,
    *,
    keys: NDArray[np.uint64] | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
) -> Estimate:
    """Estimate a_lm(x, ωo) = ∫ Ŝ Y_lm dωi [N,K,3] = E[throughput · Y_lm(exit)] from walks' exits, for any interface.

    Args:
        scene: the scene.
        positions, outgoing: [N,3], points on the surface and unit directions to the eye.
        degree: of the harmonics, K = (degree + 1)², in the order of `prt_bake.sh`.
        paths: walks per query.
        seed: of the random numbers, which depend on it, the index of the query and the path alone.
        keys: [N], replace the indices of the queries in the choice of random numbers.
        device: "cuda" traces the walks on a GPU, the same ones up to rounding.

    Raises QueryError as `estimate_transport`, except for smooth interfaces, and for a GPU that cannot be used.

    >>> import prt_bake as prt
    >>> scene = prt.load_scene("spot.toml")
    >>> x, n = scene.mesh.positions[:1], scene.mesh.normals[:1]
    >>> prt.estimate_coefficients(scene, x, n, degree=2, paths=64).mean.shape
    (1, 9, 3)
    """
    require_walks_on(device)
    prepared = prepare(scene)
    if degree < 0:
        raise QueryError(f"degree: expected 0 or more, found {degree}")
    queries = _place(prepared, positions, outgoing, keys)

    def run(chosen: slice, chunks: NDArray[np.int64], sums: Array) -> None:
        if device != "cpu":
            _sum_on_gpu(prepared, queries.rows(chosen), chunks, degree, seed, sums)
            return
        from prt_bake.tracer.kernels import sum_coefficients

        in_threads(
            sum_coefficients,
            len(chunks),
            prepared.boundary,
            prepared.medium,
            queries.rows(chosen),
            chunks,
            degree,
            seed,
            sums,
        )

    size = (degree + 1) ** 2
    return _estimate(run, len(queries.keys), paths, (size,), size, _LEAST_PATHS, math.inf)


def _sum_on_gpu(
    prepared: PreparedScene, queries: KernelQueries, chunks: NDArray[np.int64], degree: int, seed: int, sums: Array
) -> None:
    from prt_bake.tracer.gpu.exits import sum_coefficients
    from prt_bake.tracer.gpu.kernels import MOST_HARMONICS

    if (degree + 1) ** 2 > MOST_HARMONICS:
        raise QueryError(
            f"degree: expected at most {math.isqrt(MOST_HARMONICS) - 1} on a GPU, found {degree}; use the CPU"
        )
    sum_coefficients(prepared, queries, chunks, degree, seed, sums)


def _sharpness(scene: Scene, prepared: PreparedScene) -> float:
    """Peak of a single connection relative to an isotropic one: of the phase function, of the lobe of a rough boundary,
    averaged over a texture, or of rough interfaces inside, whichever is largest.

    Light that a dielectric inside refracts cannot be connected to and is `_REFRACTED_INSIDE` times as rare.
    """
    g = float(np.abs(prepared.medium.regions[:, PHASE_G]).max())
    phase = (1.0 + g) / (1.0 - g) ** 2
    rough = rough_parts(scene)
    if not rough:
        return phase
    lobes = max(float(np.mean(np.maximum(part.roughness, SMOOTHEST) ** -2.0)) for part in rough)
    return max(1.0, phase, lobes * (_REFRACTED_INSIDE if has_dielectric_inside(scene) else 1.0))


def _directions(rows: ArrayLike, name: str) -> Array:
    directions = np.asarray(rows, np.float64)
    if directions.ndim not in (2, 3) or directions.shape[-1] != 3:
        raise QueryError(f"{name}: expected an array [N,3], found shape {list(directions.shape)}")
    length = np.linalg.norm(directions, axis=-1)
    wrong = np.argwhere(~(np.abs(length - 1.0) < 1e-4))
    if len(wrong):
        first = tuple(int(i) for i in wrong[0])
        raise QueryError(
            f"{name}: expected unit vectors, found {len(wrong)} that are not; the first, at {list(first)}, has length "
            f"{length[first]:.6g}"
        )
    return np.asarray(directions / length[..., None])


def _place(
    prepared: PreparedScene, positions: ArrayLike, outgoing: ArrayLike, keys: NDArray[np.uint64] | None = None
) -> KernelQueries:
    points, eye = np.asarray(positions, np.float64), _directions(outgoing, "outgoing")
    if points.shape != eye.shape or eye.ndim != 2:
        raise QueryError(
            f"positions and outgoing: expected arrays [N,3], found {list(points.shape)} and {list(eye.shape)}"
        )
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise QueryError(f"positions: expected finite numbers, found {bad} of {len(points)} that are not finite")
    if keys is not None and np.shape(keys) != (len(points),):
        raise QueryError(f"keys: expected one for each of {len(points)} queries, found shape {list(np.shape(keys))}")
    chosen = np.arange(len(points)) if keys is None else keys
    return prepared.place(points, eye, np.asarray(chosen, np.uint64))


def _blocks(count: int, paths: int, numbers: int) -> Iterator[tuple[slice, NDArray[np.int64]]]:
    """Slices of queries whose sums fit in memory, with their chunks (query, first path, paths)."""
    per_query = -(-paths // _PATHS_PER_CHUNK)
    size = max(1, _NUMBERS_AT_ONCE // (numbers * SUMS * per_query))
    first = np.arange(0, paths, _PATHS_PER_CHUNK)
    length = np.minimum(_PATHS_PER_CHUNK, paths - first)
    for begin in range(0, count, size):
        chosen = slice(begin, min(begin + size, count))
        n = np.arange(chosen.stop - begin)
        rows = [np.repeat(n, per_query), np.tile(first, len(n)), np.tile(length, len(n))]
        yield chosen, np.ascontiguousarray(np.stack(rows, axis=1), np.int64)


def _estimate(
    run: Callable[[slice, NDArray[np.int64], Array], None],
    count: int,
    paths: int,
    shape: tuple[int, ...],
    rows: int,
    least_paths: float,
    strong: float,
) -> Estimate:
    """Sum the powers of all values by `run` and turn them into an Estimate.

    `strong` is the contribution of a walk that reaches the light; inf disables the upper bound for dark values.
    """
    if paths < 2:
        raise QueryError(f"paths: expected at least 2 for an error estimate, found {paths}")
    begun = time.perf_counter()
    sampled = _moments(run, count, paths, rows * 3 + 4)
    values = Moments(*(part[:, : rows * 3] for part in sampled))
    error, kurtosis = _error_and_kurtosis(values, paths)
    second, third, fourth = values.raw()
    touched = np.any(second.reshape(count, rows, 3) > 0.0, axis=2)
    trusted = np.repeat(touched, 3, axis=1) & (kurtosis <= paths * _KURTOSIS_PER_PATH)
    seen = np.divide(fourth, third, out=np.zeros_like(third), where=third > 0.0)
    wide = error + _RULE_OF_THREE / paths * np.maximum(strong, seen) / _BOUND
    dark = ~trusted & (values.mean + _BOUND * wide <= _DARK)
    return Estimate(
        mean=values.mean.reshape(count, *shape, 3),
        standard_error=np.where(dark, wide, error).reshape(count, *shape, 3),
        unscattered=_merged_if_equal(sampled.mean[:, -4:-1]),
        reliable=np.all(trusted | dark, axis=1) & (paths >= least_paths),
        lost=sampled.mean[:, -1],
        paths=paths,
        seconds=time.perf_counter() - begun,
    )


def _moments(run: Callable[[slice, NDArray[np.int64], Array], None], count: int, paths: int, numbers: int) -> Moments:
    """Moments [count, numbers] over all paths of each query, from the sums of its chunks."""
    moments = Moments(*np.zeros((4, count, numbers)))
    for chosen, chunks in _blocks(count, paths, numbers):
        sums = np.zeros((len(chunks), SUMS, numbers))
        run(chosen, chunks, sums)
        queries = chosen.stop - chosen.start
        walks = chunks[:, 2].reshape(queries, -1, 1)
        parts = from_sums(sums.reshape(queries, -1, SUMS, numbers).transpose(2, 0, 1, 3), walks)
        for every, some in zip(moments, merged(parts, walks, axis=1), strict=True):
            every[chosen] = some
    return moments


def _merged_if_equal(shares: Array) -> Array:
    """[N] instead of [N,3] if the channels are equal."""
    return shares[:, 0] if np.array_equal(shares, np.broadcast_to(shares[:, :1], shares.shape)) else shares


def _error_and_kurtosis(moments: Moments, paths: int) -> tuple[Array, Array]:
    """Standard error of the mean, and kurtosis: 1 for constant samples, inf if it is out of float64's range."""
    rounding = (_ROUNDING * moments.mean) ** 2
    variance = np.where(moments.variance > rounding, moments.variance, 0.0)
    varies = variance > _TINY_VARIANCE
    unit = np.where(varies, variance, 1.0)
    skewness = np.where(varies, moments.third / unit**1.5, 0.0)
    kurtosis = np.where(varies, moments.fourth / unit**2, np.where(variance > 0.0, np.inf, 1.0))
    return np.sqrt(variance / (paths - 1)) * _widened(skewness, kurtosis, paths), kurtosis


def _widened(skewness: Array, kurtosis: Array, paths: int) -> Array:
    """Factor on a standard error that gives mean ± 1.96 of it a coverage of 95 % for a skewed distribution.

    A sample that missed strong paths has a low mean and a low variance at once, so that plain bounds are too narrow.
    The factor is the second-order term of the Edgeworth expansion of the studentised mean (Hall 1992, The Bootstrap and
    Edgeworth Expansion, section 2.6), expressed as a width.
    """
    z2 = _BOUND**2
    kurtosis = np.where(np.isfinite(kurtosis), kurtosis, 3.0)
    short = skewness**2 * (z2 * z2 + 2 * z2 - 3) / 18 - (kurtosis - 3) * (z2 - 3) / 12 + (z2 + 1) / 4
    return np.asarray(1.0 + np.maximum(short, 0.0) / paths)
