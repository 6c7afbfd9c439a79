"""How well a network answers: its error on path-traced queries that it never saw, the reference's own noise taken
out.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.scene import Scene
from prt_bake import sh
from prt_bake.sphere import fibonacci
from prt_bake.trainer.estimate import estimate_coefficients
from prt_bake.trainer.prepared import PreparedScene
from prt_bake.trainer.queries import Queries, QuerySource
from prt_bake.trainer.stream import render

Array = NDArray[np.float64]

VALIDATION_SEED = 0x7E57
FINAL_SEED = 0xF17A
_COEFFICIENT_DEGREE = 2
_DIRECTIONS = 256


@dataclass(frozen=True)
class HeldOut:
    """Path-traced queries: Ŝ [N,D,3] with its standard error, never learnt from."""

    queries: Queries
    mean: Array
    standard_error: Array

    def relative_rmse(self, network: Any) -> float:
        """sqrt(Σ|f − Ŝ|² / Σ|Ŝ|²) of a network with the reference's noise Σ standard_error² taken out of both sums."""
        q = self.queries
        answer = network.evaluate(q.incident, q.positions, q.outgoing)
        return noise_free_ratio(answer, self.mean, self.standard_error)


def hold_out(prepared: PreparedScene, count: int, directions: int, walks: int, seed: int) -> HeldOut:
    """Path trace `count` queries of `directions` each with `walks` walks."""
    source = QuerySource(prepared, directions, seed)
    queries = source.draw(0, count)
    mean, error = render(prepared, source, queries, walks, directions, seed)
    return HeldOut(queries, mean, error)


def noise_free_ratio(answer: ArrayLike, mean: Array, error: Array) -> float:
    """The relative RMSE of `answer` against noisy reference values: what the reference's variance explains is
    subtracted.
    """
    noise = float(np.sum(error**2))
    difference = float(np.sum((np.asarray(answer, np.float64) - mean) ** 2)) - noise
    return float(np.sqrt(max(0.0, difference) / max(float(np.sum(mean**2)) - noise, 1e-300)))


@dataclass(frozen=True)
class FinalFigures:
    """Relative RMSE of Ŝ and of the degree-2 coefficients on fresh queries, and the size of the reference's own
    noise.
    """

    transport: float
    transport_noise: float
    coefficients: float
    coefficients_noise: float
    queries: int
    walks: int

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def final_figures(
    network: Any, scene: Scene, prepared: PreparedScene, queries: int, walks: int, seed: int = FINAL_SEED
) -> FinalFigures:
    """The figures of a trained network against the path tracer, on queries of a seed of their own."""
    fresh = hold_out(prepared, queries, 8, walks, seed)
    reference = estimate_coefficients(
        scene, fresh.queries.location.positions, fresh.queries.outgoing, _COEFFICIENT_DEGREE, 8 * walks, seed + 1
    )
    lattice = fibonacci(_DIRECTIONS)
    basis = sh.evaluate(lattice, _COEFFICIENT_DEGREE)
    values = network.evaluate(lattice, fresh.queries.positions, fresh.queries.outgoing).astype(np.float64)
    coefficients = np.einsum("kd,ndc->nkc", np.linalg.pinv(basis), values)
    return FinalFigures(
        transport=fresh.relative_rmse(network),
        transport_noise=float(np.sqrt(np.sum(fresh.standard_error**2) / np.sum(fresh.mean**2))),
        coefficients=noise_free_ratio(coefficients, reference.mean, reference.standard_error),
        coefficients_noise=float(np.sqrt(np.sum(reference.standard_error**2) / np.sum(reference.mean**2))),
        queries=queries,
        walks=walks,
    )
