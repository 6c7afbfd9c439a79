"""Plain functions as transports: what they are given, what they may return, and what is refused in one sentence."""

import functools
from types import SimpleNamespace
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


def test_what_a_transport_writes_into_its_arguments_changes_nothing_else() -> None:
    np.testing.assert_array_equal(baked(Overwriting().evaluate), baked(Lobed(2.0)))
    np.testing.assert_array_equal(baked(Overwriting()), baked(Lobed(2.0)))


class Overwriting:
    def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> Any:
        values = lobed(incident, positions, outgoing)
        for array in (incident, positions, outgoing):
            array += 1.0
        return values


@pytest.mark.filterwarnings("error")
def test_torch_takes_the_arguments_without_a_warning() -> None:
    assert baked(lambda *query: torch.as_tensor(lobed(*map(torch.from_numpy, query)))).any()


class Estimating:
    """`estimate_coefficients` that returns what `estimate` makes of ones [N,K,3]."""

    def __init__(self, estimate: Any) -> None:
        self.estimate = estimate

    def estimate_coefficients(self, positions: Any, outgoing: Any, degree: int, paths: int, seed: int) -> Any:
        return self.estimate(np.ones((len(positions), (degree + 1) ** 2, 3)))


def test_estimates_are_taken_that_are_invalid_at_a_place() -> None:
    def estimate(ones: Any) -> Any:
        ones[0] = np.nan
        return SimpleNamespace(mean=torch.as_tensor(ones), standard_error=0.1 * ones)

    with pytest.raises(prt.QueryError, match="found NaN or infinite ones at all 12 vertices"):
        baked(Estimating(estimate))
    assert (baked(Estimating(lambda ones: SimpleNamespace(mean=ones, standard_error=0.0 * ones))) == 1.0).all()


class OtherArguments:
    def evaluate(self, rows: Any) -> Any:
        return rows


class OtherEstimate:
    def estimate_coefficients(self, positions: Any, outgoing: Any) -> Any:
        return positions


class Unbound(Lobed):
    def on(self, mesh: Any) -> None:
        pass


class OfNoMethod:
    evaluate = 3


def described_by(**attributes: Any) -> Any:
    return type("Described", (Callable,), {"evaluate": Callable.__call__, **attributes})()


REFUSED = {
    r"expected a function of \(incident, positions, outgoing\), found Linear\(input\)": torch.nn.Linear(7, 3),
    r"expected a function of \(incident, positions, outgoing\), found <lambda>\(rows\)": lambda rows: rows,
    r"found OtherArguments.evaluate\(rows\)": OtherArguments(),
    r"expected a function of \(positions, outgoing, degree, paths, seed\), found OtherEstimate": OtherEstimate(),
    r"expected a method OfNoMethod.evaluate\(incident, positions, outgoing\), found 3": OfNoMethod(),
    r"Unbound.on: expected a transport, found None; end the method with `return self`": Unbound(2.0),
    r"Estimating.estimate_coefficients: expected an object with mean and standard_error, .* found a tuple": Estimating(
        lambda ones: (ones, ones)
    ),
    r"expected an object with mean and standard_error, .* found an array \[2, 9, 3\]": Estimating(lambda ones: ones),
    "expected standard errors of 0 or more, found -1 for 54 of 54 means": Estimating(
        lambda ones: SimpleNamespace(mean=ones, standard_error=-ones)
    ),
    "expected standard errors of 0 or more, found nan for 54": Estimating(
        lambda ones: SimpleNamespace(mean=ones, standard_error=np.nan * ones)
    ),
    r"the transport's mean of estimate_coefficients returned float64 of shape \(2, 3, 9\)": Estimating(
        lambda ones: SimpleNamespace(mean=ones.swapaxes(1, 2), standard_error=ones)
    ),
    "expected a dictionary as Described.metadata, found the text 'wax'": described_by(metadata="wax"),
    r"found an array \[3\] of float64 as 'albedo'": described_by(metadata={"albedo": np.ones(3)}),
    "found nan as 'error'": described_by(metadata={"error": np.nan}),
    "eta of Described must be a number, found the text 'glass'": described_by(metadata={"eta": "glass"}),
    "expected eta above 0, found -1 of Described": described_by(eta=-1),
    "roughness of Described: expected an array of numbers, found the text 'matte'": described_by(roughness="matte"),
    "expected 'y' or 'z' as up of Described, found the text 'x'": described_by(metadata={"up": "x"}),
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


def test_a_function_whose_values_float32_does_not_hold_is_named() -> None:
    with pytest.raises(prt.QueryError, match=r"^function tiny: expected coefficients from"):
        prt.bake(tiny, MESH, rings=1, sectors=2, error=0.05)


def tiny(incident: Any, positions: Any, outgoing: Any) -> Any:
    return 1e-60 * lobed(incident, positions, outgoing)


def test_a_note_on_the_training_is_no_error_of_the_network() -> None:
    assert baked(described_by(metadata={"training": "three days"})).any()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_tensors_on_a_gpu_are_taken() -> None:
    np.testing.assert_array_equal(baked(lambda *query: torch.as_tensor(lobed(*query)).cuda()), baked(Lobed(2.0)))
