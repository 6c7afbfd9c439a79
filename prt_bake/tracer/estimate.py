"""Estimates of the transport function Ŝ and of its harmonic coefficients, each with its standard error.

A query is a point x on the surface and a direction ωo to the eye. `estimate_transport` gives Ŝ(ωi; x, ωo) [1/sr] for
chosen directions of incidence, `estimate_coefficients` gives a_lm = ∫ Ŝ Y_lm dωi from where the walks leave. What
both count, and what they report apart as unscattered, is said in the README under "What Ŝ counts".
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.jit.threads import in_threads
from prt_bake.tracer.prepared import PreparedScene, has_dielectric_inside, prepare, smooth_part
from prt_bake.tracer.surface.boundary import SMOOTHEST
from prt_bake.tracer.surface.interface import ROUGH
from prt_bake.tracer.volume.media import PHASE_G

Array = NDArray[np.float64]

_PATHS_A_CHUNK = 2048
_NUMBERS_AT_ONCE = 4_000_000
_KURTOSIS_A_PATH = 1 / 5
"""An estimate is called reliable while the sample's kurtosis stays below this share of the number of paths. A stricter
share would do harm: of samples near the limit it takes those that missed the strong paths."""
_LEAST_PATHS = 64
"""So many paths are needed for a connection that is never stronger than an even spread; `_sharpness` times for others,
whose strong paths are as rare as they are strong: a sample that missed them all looks perfect."""
_BY_CHANCE = 4.0
"""For light that a dielectric inside bends (measured on a drink with ice, alpha 0.05: bounds cover 86 % at 80 times
alpha⁻² paths, 93.5 % at 160, 95 % at 330)."""
_DARK = 1e-3 / (4.0 * math.pi)
"""[1/sr]: a thousandth of an even spread of all light. Of what is surely darker an upper bound is enough."""
_UNSEEN = 3.0
"""What happens to less than `_UNSEEN` / paths of the walks stays unseen in a sample 5 times in 100 (rule of three)."""
_BRIGHT = 1.0 / math.pi
"""[1/sr]: what a walk brings that finds its way to the light, as much as white paper gives back. Behind sharp lobes it
comes in fewer, stronger paths: most of them are aimed at, the others count with `_UNAIMED` of the lobe's sharpness."""
_UNAIMED = 0.1
_CONNECTIONS = 8
_BOUND = 1.96
_TINY_VARIANCE = 1e-140
"""Below this, fourth powers underflow: the kurtosis of what is so dark is called infinite."""


@dataclass(frozen=True)
class Estimate:
    """`mean` and one-sigma `standard_error` of N queries, and what the figures rest on.

    Attributes:
        mean, standard_error: [N,3] or [N,D,3] (Ŝ, 1/sr) or [N,K,3] (coefficients). mean ± 1.96 standard_error holds the
            truth 95 times in 100 where the query is `reliable`: the error is widened by what the sample's skewness asks
            for. It holds it more often for values of Ŝ that are surely darker than 8e-5 1/sr (a thousandth of an even
            spread of all light) and rest on too few strong paths, or on none: 1.96 standard_error counts there what
            paths that were not seen may bring, 3 / paths times the strength of a strong one.
        unscattered: [N], the share of the view that goes through without a single scattering event: a delta function,
            not in `mean`. 0 behind a rough interface, where that light is a function and is counted. [N,3] where
            extinction differs between the channels.
        reliable: [N], False where the error bars cannot be trusted at this number of paths. It asks for 64 paths, times
            how much stronger than an even spread the peak of the interface's lobe or of the phase function is (a
            texture's on average), times four where a dielectric inside bends the light; and for each value that some
            path has brought anything and the sample's kurtosis stays below a fifth of the paths, or else that the
            bound above shows it to be that dark.
        lost: [N], mean throughput of walks that were cut (0 unless a walk passes ten million events).
        paths, seconds: walks a query, and what they took.
    """

    mean: Array
    standard_error: Array
    unscattered: Array
    reliable: NDArray[np.bool_]
    lost: Array
    paths: int
    seconds: float


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
    """Ŝ(ωi; x, ωo) at positions [N,3] on the surface, outgoing [N,3], incident [N,3] or [N,D,3] (one walk serves the
    D).

    `connections` is how many of the D directions each event of a walk looks at; any number gives the same expectation.
    The numbers depend on the seed, the query's place in the batch and the path alone.

    Raises QueryError for wrong shapes, directions that are not of unit length, positions off the surface, queries
    below the horizon, and for smooth interfaces, where Ŝ at a given ωi is a sum of delta functions seen by no
    connection.
    """
    prepared = prepare(scene)
    smooth = smooth_part(scene)
    if smooth is not None:
        raise QueryError(
            f"{scene.path}: the boundary of '{smooth.name}' is a smooth interface; "
            "behind it no connection to a given direction of incidence exists, so Ŝ cannot be estimated there: "
            "estimate_coefficients works, or make it rough"
        )
    towards = _directions(incident, "incident")
    single = towards.ndim == 2
    towards = np.ascontiguousarray(towards[:, None] if single else towards)
    queries = _place(prepared, positions, outgoing)
    if towards.shape[0] != len(queries[0]) or towards.shape[-1] != 3:
        raise QueryError(f"incident: shape {np.shape(incident)} where [{len(queries[0])},3] or [N,D,3] is expected")

    def run(chosen: slice, chunks: NDArray[np.int64], sums: Array) -> None:
        from prt_bake.tracer.kernels import sum_transport

        in_threads(
            sum_transport,
            len(chunks),
            prepared.boundary,
            prepared.medium,
            tuple(part[chosen] for part in queries),
            chunks,
            towards[chosen],
            connections,
            prepared.aims,
            seed,
            sums,
        )

    shape = () if single else towards.shape[1:2]
    sharpness = _sharpness(scene, prepared)
    strong = _BRIGHT * max(1.0, _UNAIMED * sharpness)
    return _estimate(run, len(queries[0]), paths, shape, towards.shape[1], _LEAST_PATHS * sharpness, strong)


def estimate_coefficients(
    scene: Scene,
    positions: ArrayLike,
    outgoing: ArrayLike,
    degree: int = 2,
    paths: int = 1024,
    seed: int = 0,
    *,
    keys: NDArray[np.uint64] | None = None,
) -> Estimate:
    """a_lm(x, ωo) = ∫ Ŝ Y_lm dωi [N,K,3] from the walks' exits: E[throughput · Y_lm(exit)], any interface.

    `keys` [N] take the place of the queries' numbers in the batch, where the random numbers must not depend on it.

    Raises QueryError as `estimate_transport`, but for smooth interfaces.
    """
    prepared = prepare(scene)
    if degree < 0:
        raise QueryError(f"degree: {degree} where 0 or more is expected")
    queries = _place(prepared, positions, outgoing, keys)

    def run(chosen: slice, chunks: NDArray[np.int64], sums: Array) -> None:
        from prt_bake.tracer.kernels import sum_coefficients

        in_threads(
            sum_coefficients,
            len(chunks),
            prepared.boundary,
            prepared.medium,
            tuple(part[chosen] for part in queries),
            chunks,
            degree,
            seed,
            sums,
        )

    size = (degree + 1) ** 2
    return _estimate(run, len(queries[0]), paths, (size,), size, _LEAST_PATHS, math.inf)


def _sharpness(scene: Scene, prepared: PreparedScene) -> float:
    """How much stronger than an even spread a single connection can be: the peak of the phase function where events
    look straight at the light, of the interface's lobe where they look through it, averaged over a texture.

    What a dielectric inside bends cannot be aimed at the light and finds it by chance alone, `_BY_CHANCE` times as
    rarely.
    """
    if prepared.kind == ROUGH:
        lobes = float(np.mean(np.maximum(scene.roughness, SMOOTHEST) ** -2.0))
        return max(1.0, lobes) * (_BY_CHANCE if has_dielectric_inside(scene) else 1.0)
    g = float(np.abs(prepared.medium.regions[:, PHASE_G]).max())
    return (1.0 + g) / (1.0 - g) ** 2


def _directions(rows: ArrayLike, name: str) -> Array:
    directions = np.asarray(rows, np.float64)
    if directions.ndim not in (2, 3) or directions.shape[-1] != 3:
        raise QueryError(f"{name}: shape {directions.shape} where [N,3] is expected")
    length = np.linalg.norm(directions, axis=-1)
    wrong = np.argwhere(~(np.abs(length - 1.0) < 1e-4))
    if len(wrong):
        first = tuple(int(i) for i in wrong[0])
        raise QueryError(
            f"{name}: {len(wrong)} directions are not of unit length; the first is at {first} with length "
            f"{length[first]:.6g}"
        )
    return np.asarray(directions / length[..., None])


def _place(
    prepared: PreparedScene, positions: ArrayLike, outgoing: ArrayLike, keys: NDArray[np.uint64] | None = None
) -> tuple[Any, ...]:
    where, eye = np.asarray(positions, np.float64), _directions(outgoing, "outgoing")
    if where.shape != eye.shape or eye.ndim != 2:
        raise QueryError(f"positions: shape {where.shape} beside outgoing {eye.shape} where both are [N,3]")
    if not np.isfinite(where).all():
        raise QueryError(f"positions: {int((~np.isfinite(where)).any(axis=1).sum())} of {len(where)} are not finite")
    return prepared.place(where, eye, np.arange(len(where), dtype=np.uint64) if keys is None else keys)


def _blocks(count: int, paths: int, numbers: int) -> Iterator[tuple[slice, NDArray[np.int64]]]:
    """Slices of queries whose sums fit in memory, each with its chunks (query, first path, paths)."""
    per_query = -(-paths // _PATHS_A_CHUNK)
    size = max(1, _NUMBERS_AT_ONCE // (numbers * 4 * per_query))
    first = np.arange(0, paths, _PATHS_A_CHUNK)
    length = np.minimum(_PATHS_A_CHUNK, paths - first)
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
    """`strong` is what a walk brings that finds its way to the light; infinite where being dark excuses nothing."""
    if paths < 2:
        raise QueryError(f"paths: {paths} where at least 2 are needed for an error estimate")
    begun = time.perf_counter()
    numbers = rows * 3 + 4
    powers = np.zeros((count, 4, numbers))
    for chosen, chunks in _blocks(count, paths, numbers):
        sums = np.zeros((len(chunks), 4, numbers))
        run(chosen, chunks, sums)
        powers[chosen] = sums.reshape(chosen.stop - chosen.start, -1, 4, numbers).sum(axis=1)
    mean, error, kurtosis = _central(powers / paths, paths)
    values = slice(0, rows * 3)
    touched = np.any(powers[:, 1, values].reshape(count, rows, 3) > 0.0, axis=2)
    trusted = np.repeat(touched, 3, axis=1) & (kurtosis[:, values] <= paths * _KURTOSIS_A_PATH)
    error[:, values], dark = _widened_in_the_dark(
        mean[:, values], error[:, values], powers[..., values], ~trusted, paths, strong
    )
    return Estimate(
        mean=mean[:, values].reshape(count, *shape, 3),
        standard_error=error[:, values].reshape(count, *shape, 3),
        unscattered=_one_where_equal(mean[:, -4:-1]),
        reliable=np.all(trusted | dark, axis=1) & (paths >= least_paths),
        lost=mean[:, -1],
        paths=paths,
        seconds=time.perf_counter() - begun,
    )


def _widened_in_the_dark(
    mean: Array, error: Array, powers: Array, doubtful: NDArray[np.bool_], paths: int, strong: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Errors [N,M] that count what unseen paths may bring where a value is doubtful and dark all the same, and where
    that is.
    """
    third, fourth = powers[:, 2], powers[:, 3]
    seen = np.divide(fourth, third, out=np.zeros_like(third), where=third > 0.0)
    wide = error + _UNSEEN / paths * np.maximum(strong, seen) / _BOUND
    dark = doubtful & (mean + _BOUND * wide <= _DARK)
    return np.where(dark, wide, error), dark


def _one_where_equal(shares: Array) -> Array:
    """[N] of [N,3] if the channels are equal."""
    return shares[:, 0] if np.array_equal(shares, np.broadcast_to(shares[:, :1], shares.shape)) else shares


def _central(raw: Array, paths: int) -> tuple[Array, Array, Array]:
    """Mean, standard error of the mean and kurtosis from raw moments [N,4,M]; kurtosis 1 where nothing varies, and
    infinite where it is out of float64's reach.
    """
    mean, second, third, fourth = (raw[:, k] for k in range(4))
    variance = np.maximum(second - mean**2, 0.0)
    variance[variance < 1e-14 * second] = 0.0
    varies = variance > _TINY_VARIANCE
    unit = np.where(varies, variance, 1.0)
    skewness = np.where(varies, (third - 3 * mean * second + 2 * mean**3) / unit**1.5, 0.0)
    central = np.maximum(fourth - 4 * mean * third + 6 * mean**2 * second - 3 * mean**4, 0.0)
    kurtosis = np.where(varies, central / unit**2, np.where(variance > 0.0, np.inf, 1.0))
    return mean, np.sqrt(variance / (paths - 1)) * _widened(skewness, kurtosis, paths), kurtosis


def _widened(skewness: Array, kurtosis: Array, paths: int) -> Array:
    """The factor by which a standard error grows for mean ± 1.96 of it to hold 95 % of a skewed sample's means.

    A sample that missed strong paths has a low mean and a low variance at once, so that plain bounds fall short. This
    is the second-order term of the studentised mean's Edgeworth expansion (Hall 1992, The Bootstrap and Edgeworth
    Expansion, section 2.6), turned into a width.
    """
    z2 = _BOUND**2
    kurtosis = np.where(np.isfinite(kurtosis), kurtosis, 3.0)
    short = skewness**2 * (z2 * z2 + 2 * z2 - 3) / 18 - (kurtosis - 3) * (z2 - 3) / 12 + (z2 + 1) / 4
    return np.asarray(1.0 + np.maximum(short, 0.0) / paths)
