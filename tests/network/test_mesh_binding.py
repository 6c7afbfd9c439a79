"""Networks with normals among their inputs: bound to a mesh, or else a warning."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.errors import InputWarning, QueryError
from formats.mesh import Mesh, build_mesh, read_mesh
from prt_bake import shipped
from prt_bake.network.bssrdf import NeuralBSSRDF, load_model
from tests.network.test_lobes import lobed

SHIPPED = Path(shipped.__file__).parent
MESSAGE = r"network: it takes normals as input .* use network\.on\(mesh\), or prt\.load_model\(path, mesh=mesh\)"


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return read_mesh(SHIPPED / "spot.obj")


def query(mesh: Mesh) -> tuple[Any, Any, Any]:
    """Incident [2,3], positions [5,3] and outgoing [5,3]."""
    return mesh.normals[:2], mesh.positions[:5], mesh.normals[:5]


def block(network: NeuralBSSRDF, mesh: Mesh) -> Any:
    incident, positions, outgoing = query(mesh)
    return network.evaluate_block(incident[None], np.zeros((5, 1), np.int64), positions, outgoing[:, None])


EVALUATIONS: dict[str, Callable[[NeuralBSSRDF, Mesh], Any]] = {
    "evaluate": lambda network, mesh: network.evaluate(*query(mesh)),
    "evaluate_block": block,
    "prepared": lambda network, mesh: network.prepared(),
    "own_lobes": lambda network, mesh: network.own_lobes(*query(mesh)[1:]),
}


@pytest.mark.parametrize("first", EVALUATIONS)
def test_the_first_evaluation_without_a_mesh_warns_once(first: str, mesh: Mesh) -> None:
    network = lobed()
    with pytest.warns(InputWarning, match=MESSAGE) as warned:
        EVALUATIONS[first](network, mesh)
    assert len(warned) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for again in EVALUATIONS.values():
            again(network, mesh)
            again(network.up_to(2), mesh)
    with pytest.warns(InputWarning, match=MESSAGE):
        EVALUATIONS[first](lobed(), mesh)  # another network warns for itself


def test_a_model_is_loaded_with_its_mesh(mesh: Mesh) -> None:
    network = load_model(SHIPPED / "spot.pt", mesh=mesh)
    assert network.surface is not None
    expected = load_model(SHIPPED / "spot.pt").on(mesh).evaluate(*query(mesh))
    np.testing.assert_array_equal(network.evaluate(*query(mesh)), expected)
    block(network, mesh)


def test_a_model_refuses_another_mesh_and_a_path(mesh: Mesh) -> None:
    with pytest.raises(QueryError, match="are not on the surface that the model was trained on"):
        load_model(SHIPPED / "spot.pt", mesh=build_mesh(2.0 * mesh.positions, mesh.faces))
    with pytest.raises(QueryError, match=r"mesh: expected what prt\.read_mesh\(path\) returns"):
        load_model(SHIPPED / "spot.pt", mesh="spot.obj")  # type: ignore[arg-type]


def test_a_network_without_normals_needs_no_mesh(mesh: Mesh) -> None:
    network = NeuralBSSRDF()
    assert network.evaluate(*query(mesh)).shape == (5, 2, 3)
    assert block(network, mesh).shape == (5, 1, 2, 3)
