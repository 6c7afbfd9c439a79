"""The error that half precision adds to a bake is measured and reported."""

from pathlib import Path

import numpy as np
import pytest

import prt_bake
from bakers.transport import on_mesh, prepared
from formats.errors import QueryError
from formats.mesh import read_mesh
from prt_bake import bake, load_model
from prt_bake.baking.job.views import views_of
from prt_bake.baking.pruning.rounding import measure_rounding
from prt_bake.baking.report.budget import error_budget
from prt_bake.geometry.camera import Camera
from prt_bake.network.bssrdf import NeuralBSSRDF
from tests.bakers.transports import Lobed, icosphere

SHIPPED = Path(prt_bake.__file__).parent / "shipped"


def without_low_bands() -> NeuralBSSRDF:
    """The shipped network by the layers of its values alone: low bands are in full precision."""
    network = load_model(SHIPPED / "spot.pt")
    assert isinstance(network, NeuralBSSRDF)
    network.set_low_bands(None)
    return network


def test_all_error_figures_include_half_precision() -> None:
    mesh, network = read_mesh(SHIPPED / "spot.obj"), without_low_bands()
    bound = on_mesh(network, mesh)
    assets = {p: bake(bound, mesh, 2, 1, 2, samples=32, precision=p, seed=3) for p in ("float32", "bfloat16")}
    exact, rounded = (assets[p].coefficients.astype(np.float64) for p in ("float32", "bfloat16"))
    true = np.sqrt(((rounded - exact) ** 2).sum() / (exact**2).sum())
    reported = {p: asset.provenance["estimated_relative_rmse"] for p, asset in assets.items()}
    assert "rounding" not in reported["float32"]
    assert 0.5 < reported["bfloat16"]["rounding"] / true < 2.0
    expected = np.hypot(reported["float32"]["total"], reported["bfloat16"]["rounding"])
    assert reported["bfloat16"]["total"] == pytest.approx(expected, rel=0.02)
    assert (assets["bfloat16"].standard_error >= 0.99 * assets["float32"].standard_error).mean() > 0.9


def test_an_error_below_rounding_raises() -> None:
    mesh, network = read_mesh(SHIPPED / "spot.obj"), without_low_bands()
    for directions in ("fibonacci", "sobol"):
        with pytest.raises(QueryError, match=r"half precision alone adds 0\.004.*float32"):
            bake(network, mesh, 2, 1, 4, directions, error=0.001, precision="bfloat16")


def test_transports_in_full_precision_are_not_measured() -> None:
    mesh = icosphere(0)
    assert measure_rounding(Lobed(), mesh, views_of(mesh, 4, 8), 32, 2, 0) == (0.0, 0)
    shipped = read_mesh(SHIPPED / "spot.obj")
    network = prepared(on_mesh(load_model(SHIPPED / "spot.pt"), shipped), "float32", "cpu")
    assert measure_rounding(network, shipped, views_of(shipped, 4, 8), 32, 2, 0) == (0.0, 0)
    assert network.exact() is network


@pytest.mark.statistics
def test_the_error_budget_has_a_part_for_half_precision() -> None:
    mesh = read_mesh(SHIPPED / "spot.obj")
    sky = np.ones((8, 16, 3), np.float32)
    view = Camera(np.array([0.0, 0.0, 4.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), 40.0, 16, 16)
    network = on_mesh(without_low_bands(), mesh)
    for precision in ("float32", "bfloat16"):
        fast = prepared(network, precision, "cpu")
        parts = error_budget(fast, fast, mesh, sky, view, degree=1, rings=1, sectors=4, up="y", points=8, seed=0)
        own = [part for part in parts if part.name == "bfloat16"]
        assert len(own) == (precision == "bfloat16")
        assert all(0.0 < part.radiance < 0.05 for part in own)
