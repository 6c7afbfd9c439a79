"""Bakes with fixed samples of a transport that changes faster with the view than the bins resolve."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bakers.error_estimate import neighbour_errors
from prt_bake import bake
from tests.bakers.transports import Counting
from tests.baking.test_bake import ball

Array = NDArray[np.float64]


class Faceted:
    """A smooth transport times a function that differs between neighbouring bins."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        bright = 1.0 + 0.5 * np.sign(np.sin(90.0 * outgoing[:, 0]) * np.sin(90.0 * outgoing[:, 1]))
        normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
        lobe = np.exp(np.einsum("ndi,ni->nd", incident, normals))
        return (lobe * bright[:, None])[..., None] * np.array([1.0, 0.8, 0.5])


@pytest.mark.parametrize("samples", [32, 64])
def test_variation_with_the_view_is_not_reported_as_an_error(samples: int) -> None:
    mesh, counted = ball(12), Counting(Faceted())
    asset = bake(counted, mesh, 2, 4, 64, samples=samples, seed=3)
    reference = bake(Faceted(), mesh, 2, 4, 64, samples=1024, seed=4).coefficients
    squared = ((asset.coefficients - reference) ** 2).mean(axis=(2, 3))
    stated = asset.standard_error.astype(np.float64)
    assert np.sqrt((stated**2).mean() / squared.mean()) == pytest.approx(1.0, abs=0.2)
    # Neighbouring bins differ a hundred times as much.
    assert (neighbour_errors(asset.coefficients.astype(np.float64), 64) ** 2).mean() > 1e4 * squared.mean()
    # Four bins of each vertex are evaluated twice.
    assert counted.evaluations == asset.provenance["evaluations"] == len(mesh.positions) * (256 + 4) * samples
