"""Plain functions as transports: what they are given, what they may return, and what is refused in one sentence."""

import functools
from typing import Any

import numpy as np
import pytest
import torch

import prt_bake as prt
from bakers.plain_function import as_transport
from tests.bakers.transports import Edged, Lobed, icosphere

MESH = icosphere(0)


def lobed(incident: Any, positions: Any, outgoing: Any) -> Any:
    return Lobed(2.0).evaluate(incident, positions, outgoing)


def baked(transport: Any) -> np.ndarray:
    return np.asarray(prt.bake(transport, MESH, rings=1, sectors=2, samples=64).coefficients)


class Callable:
    def __call__(self, incident: Any, positions: Any, outgoing: Any) -> Any:
        return lobed(incident, positions, outgoing)


class Module(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))

    def forward(self, incident: Any, positions: Any, outgoing: Any) -> torch.Tensor:
        return self.gain * torch.as_tensor(lobed(incident, positions, outgoing))


SAME = {
    "function": lobed,
    "lambda": lambda light, x, eye: lobed(light, x, eye),
    "partial": functools.partial(lobed),
    "object": Callable(),
    "torch module with gradients": Module(),
    "nested lists": lambda *query: lobed(*query).tolist(),
    "with options": lambda incident, positions, outgoing, gain=1.0: gain * lobed(incident, positions, outgoing),
}


@pytest.mark.parametrize("kind", SAME)
def test_a_function_is_baked_as_an_object_that_evaluates_it(kind: str) -> None:
    np.testing.assert_array_equal(baked(SAME[kind]), baked(Lobed(2.0)))


@pytest.mark.parametrize("half", [lambda v: v.astype(np.float16), lambda v: torch.as_tensor(v).bfloat16()])
def test_half_precision_is_taken(half: Any) -> None:
    np.testing.assert_allclose(baked(lambda *query: half(lobed(*query))), baked(Lobed(2.0)), atol=0.01)


def test_whole_numbers_are_taken() -> None:
    ones = baked(lambda incident, positions, outgoing: np.ones(incident.shape, int))
    np.testing.assert_allclose(ones[:, :, 0], np.sqrt(4 * np.pi), rtol=1e-5)


def test_a_function_gets_a_set_of_directions_per_query() -> None:
    given = []
    transport = as_transport(lambda incident, positions, outgoing: given.append(incident) or incident)
    transport.evaluate(np.eye(3)[:2], MESH.positions[:5], MESH.normals[:5])
    assert given[0].shape == (5, 2, 3)


def test_lobes_and_pictures_take_functions() -> None:
    sharp = Lobed(20.0)
    asset = prt.bake(sharp, MESH, rings=1, sectors=2, samples=64)
    one, other = (prt.add_lobes(asset, each) for each in (lambda *query: sharp.evaluate(*query), sharp))
    assert one.provenance["lobes"]["beyond_harmonics"] > 0.1
    assert one.provenance["lobes"] == other.provenance["lobes"]
    camera = prt.fit_camera(MESH, 8, 6)
    white = np.ones((4, 8, 3))
    pictures = [prt.render_network(each, MESH, white, camera, spp=4).image for each in (lobed, Lobed(2.0))]
    assert pictures[0].max() > 0.1
    np.testing.assert_array_equal(*pictures)


class OtherArguments:
    def evaluate(self, rows: Any) -> Any:
        return rows


REFUSED = {
    r"expected a function of \(incident, positions, outgoing\), found Linear\(input\)": torch.nn.Linear(7, 3),
    r"expected a function of \(incident, positions, outgoing\), found <lambda>\(rows\)": lambda rows: rows,
    r"found OtherArguments.evaluate\(rows\)": OtherArguments(),
    r"\(incident, positions, outgoing\) in this order, found <lambda>\(positions, incident, outgoing\)": (
        lambda positions, incident, outgoing: lobed(incident, positions, outgoing)
    ),
    "found the class Edged; give Edged": Edged,
    "or a function of these, found 3": 3,
    r"function <lambda> returned float64 of shape \(24, 32\), expected real numbers of shape \(24, 32, 3\)": (
        lambda *query: lobed(*query)[..., 0]
    ),
    "function <lambda>: expected real numbers, found complex128": lambda *query: lobed(*query) + 0j,
    "function <lambda>: expected real numbers, found complex64": (
        lambda *query: torch.as_tensor(lobed(*query)).to(torch.complex64)
    ),
    "function <lambda>: expected real numbers, found bool": lambda *query: lobed(*query) > 0.1,
    "function <lambda>: expected real numbers, found an array .* of object": lambda *query: lobed(*query).astype(
        object
    ),
    "function <lambda>: expected real numbers, found None": lambda *query: None,
    "function <lambda>: expected numbers in an array of one shape, found a list": lambda *query: [[1.0], [1.0, 2.0]],
    r"function <lambda>: expected numbers in an array of one shape, found an array \[24, 32, 3\]": (
        lambda *query: torch.as_tensor(lobed(*query)).to_sparse()
    ),
    "found a masked array": lambda *query: np.ma.masked_less(lobed(*query), 0.3),
    "function <lambda>: expected finite values, found NaN or infinite ones at all 12 vertices": (
        lambda *query: np.nan * lobed(*query)
    ),
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_other_functions_and_results_are_refused(sentence: str) -> None:
    with pytest.raises(prt.QueryError, match=sentence):
        baked(REFUSED[sentence])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_tensors_on_a_gpu_are_taken() -> None:
    np.testing.assert_array_equal(baked(lambda *query: torch.as_tensor(lobed(*query)).cuda()), baked(Lobed(2.0)))
