"""The error ladder of a pilot, compared with bakes of the whole mesh."""

from typing import Any

import numpy as np
import pytest

from prt_bake import bake
from prt_bake.baking.job.sample_pilot import error_ladder
from tests.bakers.transports import Kinked, icosphere

MESH = icosphere(3)
GRID: dict[str, Any] = {"rings": 4, "sectors": 16}


class Rough:
    """A narrow bright lobe at one vertex in a hundred, smooth at the others."""

    def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> Any:
        found = Kinked().evaluate(incident, positions, outgoing)
        rough = np.isin(np.round(positions @ [1.0, 7.0, 31.0], 6), ROUGH)
        narrow = np.exp(80.0 * (-np.einsum("ndi,ni->nd", incident, outgoing) - 1.0))
        return found + np.where(rough[:, None, None], 40.0 * narrow[..., None], 0.0)


ROUGH = np.round(MESH.positions[5::107] @ [1.0, 7.0, 31.0], 6)


@pytest.mark.statistics
@pytest.mark.parametrize("seed", range(3))
def test_the_ladder_predicts_bakes_with_most_of_the_error_at_few_vertices(seed: int) -> None:
    samples = (32, 64, 128)
    bakes = [bake(Rough(), MESH, **GRID, samples=count) for count in samples]
    reported = [baked.provenance["estimated_relative_rmse"]["total"] for baked in bakes]
    ladder = error_ladder(Rough(), MESH, **GRID, samples=samples, seed=seed, baked=bakes[0])
    np.testing.assert_allclose(ladder[:, 2], reported, rtol=0.2)
