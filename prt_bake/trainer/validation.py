"""How well a network answers: its error on path-traced queries that it never saw, the reference's own noise taken
out.

Behind a smooth interface Ŝ has no point values, and the coefficients a_lm alone are compared.
"""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bakers.transport import up_to
from formats.scene import Scene
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.prepared import PreparedScene, is_unbent, prepare, smooth_part
from prt_bake.trainer.samples.queries import Queries, QuerySource
from prt_bake.trainer.samples.rows import render

Array = NDArray[np.float64]

VALIDATION_SEED = 0x7E57
FINAL_SEED = 0xF17A
_COEFFICIENT_DEGREE = 2
_DIRECTIONS = 512
_DIRECTIONS_ON_THE_WAY = 256
"""Coefficients cost a network many more answers than values do: on the way fewer queries and directions must do."""


class Reference(Protocol):
    """Path-traced answers that a network is compared with: values of Ŝ ("transport") or "coefficients"."""

    of: ClassVar[str]

    def relative_rmse(self, network: Any) -> float:
        """The network's error over the size of the answers, the reference's noise taken out of both."""

    def scale(self) -> float:
        """The root mean square of Ŝ [1/sr], or what is known of it."""


@dataclass(frozen=True)
class HeldOut:
    """Path-traced queries: Ŝ [N,D,3] with its standard error, never learnt from."""

    of: ClassVar[str] = "transport"
    queries: Queries
    mean: Array
    standard_error: Array

    def relative_rmse(self, network: Any) -> float:
        """sqrt(Σ|f − Ŝ|² / Σ|Ŝ|²) of a network with the reference's noise Σ standard_error² taken out of both sums."""
        q = self.queries
        answer = network.evaluate(q.incident, q.positions, q.outgoing)
        return noise_free_ratio(answer, self.mean, self.standard_error)

    def scale(self) -> float:
        """The root mean square of Ŝ."""
        return float(np.sqrt(np.mean(self.mean**2)))


@dataclass(frozen=True)
class HeldOutCoefficients:
    """Path-traced coefficients a_lm [N,K,3] of N queries with their standard error, never learnt from."""

    of: ClassVar[str] = "coefficients"
    positions: Array
    outgoing: Array
    mean: Array
    standard_error: Array
    directions: int

    def relative_rmse(self, network: Any) -> float:
        """sqrt(Σ|â − a|² / Σ|a|²) of a network's coefficients, the reference's noise taken out of both sums."""
        found = network_coefficients(network, self.positions, self.outgoing, self.directions)
        return noise_free_ratio(found, self.mean, self.standard_error)

    def scale(self) -> float:
        """The root mean square over the sphere of Ŝ without its bands above the second, a lower bound of Ŝ's own."""
        return float(np.sqrt(np.mean(np.sum(self.mean**2, axis=1)) / (4.0 * np.pi)))


def hold_out(prepared: PreparedScene, count: int, directions: int, walks: int, seed: int) -> HeldOut:
    """Path trace `count` queries of `directions` each with `walks` walks."""
    source = QuerySource(prepared, directions, seed)
    queries = source.draw(0, count)
    mean, error = render(prepared, source, queries, walks, directions, seed)
    return HeldOut(queries, mean, error)


def hold_out_coefficients(scene: Scene, count: int, walks: int, seed: int, directions: int) -> HeldOutCoefficients:
    """Path trace the coefficients of `count` queries with `walks` walks; networks answer in `directions`."""
    queries = QuerySource(prepare(scene), 1, seed).draw(0, count)
    found = estimate_coefficients(
        scene, queries.location.positions, queries.outgoing, _COEFFICIENT_DEGREE, walks, seed + 1
    )
    return HeldOutCoefficients(queries.positions, queries.outgoing, found.mean, found.standard_error, directions)


def validation_reference(scene: Scene, prepared: PreparedScene, queries: int, walks: int) -> Reference:
    """What a training of the scene is watched by: values, or coefficients where those are had for a tenth."""
    if is_unbent(scene):
        return hold_out(prepared, queries, 8, walks, VALIDATION_SEED)
    return hold_out_coefficients(scene, max(1, queries // 4), 8 * walks, VALIDATION_SEED, _DIRECTIONS_ON_THE_WAY)


def network_coefficients(network: Any, positions: Array, outgoing: Array, directions: int = _DIRECTIONS) -> Array:
    """A network's a_lm [N,9,3], fitted to its values on a lattice of `directions`."""
    lattice = fibonacci(directions)
    basis = sh.evaluate(lattice, _COEFFICIENT_DEGREE)
    values = up_to(network, _COEFFICIENT_DEGREE).evaluate(lattice, positions, outgoing).astype(np.float64)
    return np.asarray(np.einsum("kd,ndc->nkc", np.linalg.pinv(basis), values))


def noise_free_ratio(answer: ArrayLike, mean: Array, error: Array) -> float:
    """The relative RMSE of `answer` against noisy reference values: what the reference's variance explains is
    subtracted.
    """
    noise = float(np.sum(error**2))
    difference = float(np.sum((np.asarray(answer, np.float64) - mean) ** 2)) - noise
    return float(np.sqrt(max(0.0, difference) / max(float(np.sum(mean**2)) - noise, 1e-300)))


@dataclass(frozen=True)
class FinalErrors:
    """Relative RMSE of Ŝ and of the degree-2 coefficients on fresh queries, and the size of the reference's own
    noise; None for Ŝ behind a smooth interface, where it has no point values.
    """

    transport: float | None
    transport_noise: float | None
    coefficients: float
    coefficients_noise: float
    queries: int
    walks: int

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def final_errors(
    network: Any, scene: Scene, prepared: PreparedScene, queries: int, walks: int, seed: int = FINAL_SEED
) -> FinalErrors:
    """The figures of a trained network against the path tracer, on queries of a seed of their own."""
    values = hold_out(prepared, queries, 8, walks, seed) if smooth_part(scene) is None else None
    reference = hold_out_coefficients(scene, queries, 8 * walks, seed, _DIRECTIONS)
    return FinalErrors(
        transport=None if values is None else values.relative_rmse(network),
        transport_noise=None if values is None else _noise(values),
        coefficients=reference.relative_rmse(network),
        coefficients_noise=_noise(reference),
        queries=queries,
        walks=walks,
    )


def _noise(reference: HeldOut | HeldOutCoefficients) -> float:
    return float(np.sqrt(np.sum(reference.standard_error**2) / max(float(np.sum(reference.mean**2)), 1e-300)))
