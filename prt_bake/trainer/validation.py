"""Validation of networks: their error on held-out path-traced queries, corrected for the reference's noise.

Ŝ has no point values behind a smooth interface; only the coefficients a_lm are compared there.
"""

import math
import time
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bakers.transport import up_to
from formats.scene import Scene
from prt_bake.mathematics import sh
from prt_bake.mathematics.noise_free import Interval, relative_rmse
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.prepared import PreparedScene, is_unrefracted, prepare, smooth_part
from prt_bake.trainer.references import (
    FIRST_BATCHES,
    Estimate,
    Follow,
    Predict,
    TracedReference,
    silent,
    trace_reference,
)
from prt_bake.trainer.samples.queries import Queries, QuerySource
from prt_bake.trainer.samples.rows import trace_values

Array = NDArray[np.float64]
Device = Literal["cpu", "cuda"]

VALIDATION_SEED = 0x7E57
FINAL_SEED = 0xF17A
_DEGREE = 2
_BATCHES = 64
"""Batches of the walks of a query. The first eight are traced for all queries before the others."""
_VALUES_SHARE = 0.3
"""Share of the time of the final figures for the values of Ŝ; the coefficients get the rest."""
_ONLY_NOISE = 0.9
"""A reference of this relative noise is hardly more than noise, which a difference of squares would hide."""
_DIRECTIONS = 512
_VALIDATION_DIRECTIONS = 256
"""Directions while training. Coefficients need many more evaluations than values, so fewer queries and directions are
used until the run ends."""


class Reference(Protocol):
    """Path-traced reference of a network: values of Ŝ ("transport") or a_lm ("coefficients")."""

    quantity: ClassVar[str]

    def relative_rmse(self, network: Any) -> float:
        """The network's relative RMSE, corrected for the reference's noise."""

    def scale(self) -> float:
        """The root mean square of Ŝ [1/sr], or a lower bound of it."""


@dataclass(frozen=True)
class HeldOut:
    """Held-out queries: path-traced Ŝ [N,D,3] with its standard error."""

    quantity: ClassVar[str] = "transport"
    queries: Queries
    mean: Array
    standard_error: Array

    def relative_rmse(self, network: Any) -> float:
        """sqrt(Σ|f − Ŝ|² / Σ|Ŝ|²) of a network f, the reference's noise Σ standard_error² subtracted from both sums."""
        q = self.queries
        predicted = network.evaluate(q.incident, q.positions, q.outgoing)
        return noise_free_ratio(predicted, self.mean, self.standard_error)

    def scale(self) -> float:
        """The root mean square of Ŝ."""
        return float(np.sqrt(np.mean(self.mean**2)))


@dataclass(frozen=True)
class HeldOutCoefficients:
    """Held-out queries: path-traced coefficients a_lm [N,K,3] with their standard error."""

    quantity: ClassVar[str] = "coefficients"
    positions: Array
    outgoing: Array
    mean: Array
    standard_error: Array
    directions: int

    def relative_rmse(self, network: Any) -> float:
        """sqrt(Σ|â − a|² / Σ|a|²) of a network's coefficients â, the reference's noise subtracted from both sums."""
        predicted = network_coefficients(network, self.positions, self.outgoing, self.directions)
        return noise_free_ratio(predicted, self.mean, self.standard_error)

    def scale(self) -> float:
        """The root mean square of the bands of Ŝ up to the second, a lower bound of that of Ŝ."""
        return float(np.sqrt(np.mean(np.sum(self.mean**2, axis=1)) / (4.0 * np.pi)))


def hold_out(
    prepared: PreparedScene,
    count: int,
    directions: int,
    walks: int,
    seed: int,
    seconds: float = math.inf,
    follow: Follow = silent,
) -> HeldOut:
    """Path trace `count` queries with `directions` directions and `walks` walks each; fewer if `seconds` are over."""
    queries, traced = _traced_values(prepared, count, directions, walks, seed, seconds, follow)
    return HeldOut(queries, traced.estimates.mean, traced.standard_error)


def _traced_values(
    prepared: PreparedScene,
    count: int,
    directions: int,
    walks: int,
    seed: int,
    seconds: float,
    follow: Follow,
    network: Any = None,
) -> tuple[Queries, TracedReference]:
    source = QuerySource(prepared, directions, seed)
    queries = source.draw(0, count)

    def estimate(rows: slice, paths: int, key: int) -> Array:
        return trace_values(prepared, source, queries.select(rows), paths, directions, key)[0]

    def predict(rows: slice) -> Array:
        some = queries.select(rows)
        return np.asarray(network.evaluate(some.incident, some.positions, some.outgoing))

    traced = _traced(estimate, None if network is None else predict, count, walks, seed, seconds, follow)
    return queries.select(slice(0, len(traced))), traced


def hold_out_coefficients(
    scene: Scene,
    count: int,
    walks: int,
    seed: int,
    directions: int,
    device: Device = "cpu",
    seconds: float = math.inf,
    follow: Follow = silent,
) -> HeldOutCoefficients:
    """Path trace the coefficients of `count` queries with `walks` walks, fewer if `seconds` are over.

    Networks are evaluated in `directions`.
    """
    queries, traced = _traced_coefficients(scene, count, walks, seed, device, seconds, follow)
    return HeldOutCoefficients(
        queries.positions, queries.outgoing, traced.estimates.mean, traced.standard_error, directions
    )


def _traced_coefficients(
    scene: Scene,
    count: int,
    walks: int,
    seed: int,
    device: Device,
    seconds: float,
    follow: Follow,
    network: Any = None,
) -> tuple[Queries, TracedReference]:
    queries = QuerySource(prepare(scene), 1, seed).draw(0, count)

    def estimate(rows: slice, paths: int, key: int) -> Array:
        some = queries.select(rows)
        positions, outgoing = some.location.positions, some.outgoing
        return estimate_coefficients(scene, positions, outgoing, _DEGREE, paths, key, device=device).mean

    def predict(rows: slice) -> Array:
        some = queries.select(rows)
        return network_coefficients(network, some.positions, some.outgoing)

    traced = _traced(estimate, None if network is None else predict, count, walks, seed + 1, seconds, follow)
    return queries.select(slice(0, len(traced))), traced


def _traced(
    estimate: Estimate,
    predict: Predict | None,
    count: int,
    walks: int,
    seed: int,
    seconds: float,
    follow: Follow,
) -> TracedReference:
    """Trace `count` queries with `walks` walks each, fewer if `seconds` are over."""
    batches = _batches(walks)
    return trace_reference(
        estimate, count, *batches, predict=predict, until_precise=False, seconds=seconds, seed=seed, follow=follow
    )


def _batches(walks: int) -> tuple[int, int]:
    """Walks per query of a batch, and the number of batches."""
    paths = max(2, walks // _BATCHES)
    return paths, max(FIRST_BATCHES, walks // paths)


def validation_reference(
    scene: Scene,
    queries: int,
    walks: int,
    device: Device = "cpu",
    seconds: float = math.inf,
    follow: Follow = silent,
) -> Reference:
    """The reference of the validation error: values, or coefficients where those cost a tenth."""
    if is_unrefracted(scene):
        return hold_out(prepare(scene), queries, 8, walks, VALIDATION_SEED, seconds, follow)
    return hold_out_coefficients(
        scene, max(1, queries // 4), 8 * walks, VALIDATION_SEED, _VALIDATION_DIRECTIONS, device, seconds, follow
    )


def network_coefficients(network: Any, positions: Array, outgoing: Array, directions: int = _DIRECTIONS) -> Array:
    """A network's a_lm [N,9,3], fitted to its values on a lattice of `directions`."""
    lattice = fibonacci(directions)
    basis = sh.evaluate(lattice, _DEGREE)
    values = up_to(network, _DEGREE).evaluate(lattice, positions, outgoing).astype(np.float64)
    return np.asarray(np.einsum("kd,ndc->nkc", np.linalg.pinv(basis), values))


def noise_free_ratio(predicted: ArrayLike, mean: Array, error: Array) -> float:
    """The relative RMSE of `predicted` against a noisy reference, whose variance is subtracted from both sums.

    NaN if the reference is dark: nothing is left beside its noise.
    """
    noise = float(np.sum(error**2))
    difference = float(np.sum((np.asarray(predicted, np.float64) - mean) ** 2)) - noise
    light = float(np.sum(mean**2)) - noise
    return float(np.sqrt(max(0.0, difference) / light)) if light > 0.0 else math.nan


@dataclass(frozen=True)
class FinalErrors:
    """Relative RMSE of Ŝ and of the degree-2 coefficients on fresh queries, and the reference's relative noise.

    The noise of the reference is subtracted. If nothing is left, the error is the upper end of its interval, and None
    without one. Ŝ has neither behind a smooth interface, where it has no point values. The interval is the 95 %
    confidence interval of the coefficients' error; None if it is unknown, as for few queries. queries, walks: those of
    the coefficients.
    """

    transport: float | None
    transport_noise: float | None
    coefficients: float | None
    coefficients_interval: list[float] | None
    coefficients_noise: float
    queries: int
    walks: int


def final_errors(
    network: Any,
    scene: Scene,
    queries: int,
    walks: int,
    device: Device = "cpu",
    seconds: float = math.inf,
    follow: Follow = silent,
) -> FinalErrors:
    """The errors of a trained network against the path tracer, on queries of a separate seed.

    `seconds` limits the time: then fewer queries are traced, with fewer walks each, and the interval is wider.
    """
    begun = time.perf_counter()
    values = None
    if smooth_part(scene) is None:
        share = _VALUES_SHARE if math.isfinite(seconds) else 1.0

        def follow_values(done: float) -> None:
            follow(_VALUES_SHARE * done)

        limit = share * seconds
        _queries, values = _traced_values(prepare(scene), queries, 8, walks, FINAL_SEED, limit, follow_values, network)
    left = max(0.0, seconds - (time.perf_counter() - begun))

    def follow_coefficients(done: float) -> None:
        follow(_VALUES_SHARE + (1.0 - _VALUES_SHARE) * done)

    traced = _traced_coefficients(scene, queries, 8 * walks, FINAL_SEED, device, left, follow_coefficients, network)[1]
    error, of_values = _known_error(traced), None if values is None else _known_error(values)
    return FinalErrors(
        transport=None if of_values is None or of_values.is_bound else of_values.value,
        transport_noise=None if values is None else _noise_of(values),
        coefficients=None if error is None else error.value,
        coefficients_interval=None if error is None or np.isnan(error.low) else [error.low, error.high],
        coefficients_noise=_noise_of(traced),
        queries=len(traced),
        walks=traced.walks,
    )


def _known_error(traced: TracedReference) -> Interval | None:
    """The error of the predictions; the upper end of its interval if noise hides the rest, None without one."""
    error = relative_rmse(traced.errors(), FINAL_SEED) if _noise_of(traced) < _ONLY_NOISE else None
    if error is None:
        return None
    error = error.or_bound()
    return error if error.value > 0.0 else None


def _noise_of(traced: TracedReference) -> float:
    return _relative(traced.standard_error, traced.estimates.mean)


def relative_noise(reference: HeldOut | HeldOutCoefficients) -> float:
    """The root mean square standard error of a reference over the root mean square of its values."""
    return _relative(reference.standard_error, reference.mean)


def _relative(error: Array, values: Array) -> float:
    return float(np.sqrt(np.sum(error**2) / max(float(np.sum(values**2)), 1e-300)))
