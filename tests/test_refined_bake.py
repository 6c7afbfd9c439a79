"""Bakes to an error: it is reached, what is said of it is true, and it takes a small part of the evaluations."""

import numpy as np
import pytest
from transports import Array, Chequered, Counting, Edged, Incoherent, Lobed, exact, icosphere, uniform_needs

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake import bake, sh

ERROR = 0.01
CASES = {
    # Least ratio of evaluations to plain Monte Carlo's, all included: pilot, checks and passes.
    "edged": (Edged(), 5000.0),
    "lobed": (Lobed(), 3000.0),
    "incoherent": (Incoherent(), 900.0),
    "chequered": (Chequered(), 700.0),
}


def relative(off: Array, truth: Array) -> float:
    return float(np.sqrt((off**2).sum() / (truth**2).sum()))


@pytest.mark.parametrize("name", CASES)
def test_the_error_asked_for_is_reached_and_told(name: str) -> None:
    transport, least = CASES[name]
    mesh = icosphere(1)
    counted = Counting(transport)
    asset = bake(counted, mesh, error=ERROR)
    truth = exact(transport, mesh, 16, 64)
    off = asset.coefficients - truth
    true = relative(off, truth)
    told = asset.provenance["estimated_relative_rmse"]["total"]
    assert true <= 1.1 * ERROR
    assert 0.75 < told / true < 1.33
    within = (np.sqrt((off**2).mean(axis=(2, 3))) <= 1.96 * asset.standard_error).mean()
    assert 0.85 < within < 1.0
    bins = len(mesh.positions) * 1024
    assert counted.evaluations == asset.provenance["evaluations"]
    assert uniform_needs(transport, mesh, truth, 16, 64, ERROR) > least * counted.evaluations / bins
    assert asset.coefficients.shape == (42, 1024, 9, 3)
    assert asset.valid.all()
    assert asset.complete


def test_smaller_errors_cost_more_and_are_reached() -> None:
    mesh, spent = icosphere(0), []
    truth = exact(Lobed(), mesh, 8, 32)
    for error in (0.08, 0.02, 0.004):
        asset = bake(Lobed(), mesh, rings=8, sectors=32, error=error, seed=4)
        assert relative(asset.coefficients - truth, truth) < 1.1 * error
        spent.append(asset.provenance["evaluations"])
    assert spent[0] < spent[1] < spent[2]


@pytest.mark.parametrize(("degree", "rings", "sectors"), [(0, 1, 1), (8, 1, 1), (8, 4, 8), (1, 3, 5), (2, 1, 64)])
def test_any_degree_and_any_bins(degree: int, rings: int, sectors: int) -> None:
    mesh = icosphere(0)
    asset = bake(Edged(), mesh, degree, rings, sectors, error=0.05)
    truth = exact(Edged(), mesh, rings, sectors, degree)
    assert relative(asset.coefficients - truth, truth) < 0.055
    assert asset.coefficients.shape == (12, rings * sectors, sh.count(degree), 3)


def one_vertex() -> Mesh:
    return Mesh(np.array([[0.0, 0.0, 1.0]]), np.zeros((0, 3), np.int32), np.array([[0.0, 0.0, 1.0]]))


class Scaled:
    """Ŝ = a number, or what a function makes of the clamped cosine."""

    def __init__(self, of_cosine: object) -> None:
        self.of_cosine = of_cosine

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        cosine = np.einsum("ndi,ni->nd", incident, positions)
        return np.repeat(self.of_cosine(cosine, positions)[..., None], 3, axis=-1)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("name", "of_cosine"),
    [
        ("constant", lambda c, x: np.full_like(c, 0.7)),
        ("zero", lambda c, x: np.zeros_like(c)),
        ("negative in places", lambda c, x: c**3 - 0.2),
        ("of a dynamic range of 10⁴", lambda c, x: np.maximum(c, 0.0) * 10.0 ** (4.0 * (x[:, 2:] > 0.0))),
        ("tiny", lambda c, x: 1e-30 * np.maximum(c, 0.0)),
        ("huge", lambda c, x: 1e25 * np.maximum(c, 0.0)),
    ],
)
def test_what_networks_may_be(name: str, of_cosine: object) -> None:
    mesh, transport = icosphere(0), Scaled(of_cosine)
    asset = bake(transport, mesh, rings=4, sectors=16, error=0.02)
    truth = exact(transport, mesh, 4, 16)
    assert asset.valid.all()
    assert np.sqrt(((asset.coefficients - truth) ** 2).sum()) <= 0.022 * np.sqrt((truth**2).sum())


def test_a_narrow_spike_is_told_of() -> None:
    # Two degrees wide: most sets of directions miss it. What is asked for may be missed, but not silently.
    mesh, transport = icosphere(0), Lobed(sharpness=3000.0, floor=0.001)
    asset = bake(transport, mesh, rings=4, sectors=16, error=0.05)
    truth = exact(transport, mesh, 4, 16, directions=1 << 16)
    true = relative(asset.coefficients - truth, truth)
    assert asset.provenance["estimated_relative_rmse"]["total"] > 0.5 * true


def test_a_vertex_that_is_not_finite_is_named_and_the_rest_baked() -> None:
    mesh = icosphere(1)
    bad = 17

    def cracked(cosine: Array, positions: Array) -> Array:
        at = np.all(np.isclose(positions, mesh.positions[bad]), axis=1)
        return np.where(at[:, None], np.nan, np.maximum(cosine, 0.0))

    asset = bake(Scaled(cracked), mesh, rings=4, sectors=16, error=0.03)
    assert np.flatnonzero(~asset.valid.astype(bool)).tolist() == [bad]
    assert asset.provenance["vertices_not_finite"] == {"count": 1, "first": [bad]}
    truth = exact(Scaled(lambda c, x: np.maximum(c, 0.0)), mesh, 4, 16)
    good = asset.valid.astype(bool)
    assert relative((asset.coefficients - truth)[good], truth[good]) < 0.033
    with pytest.raises(QueryError, match="not finite"):
        bake(Scaled(lambda c, x: c * np.nan), mesh, rings=4, sectors=16, error=0.03)


def test_one_vertex() -> None:
    mesh = one_vertex()
    asset = bake(Lobed(), mesh, error=0.02)
    truth = exact(Lobed(), mesh, 16, 64)
    assert relative(asset.coefficients - truth, truth) < 0.022


def test_numbers_do_not_depend_on_workers_or_on_the_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = icosphere(1)
    whole = bake(Incoherent(), mesh, rings=4, sectors=16, error=0.05)
    threads = bake(Incoherent(), mesh, rings=4, sectors=16, error=0.05, workers=3)
    monkeypatch.setattr("prt_bake.bake_refined.BINS_AT_ONCE", 5 * 64)
    cut = bake(Incoherent(), mesh, rings=4, sectors=16, error=0.05)
    for other in (threads, cut):
        np.testing.assert_array_equal(other.coefficients, whole.coefficients)
        np.testing.assert_array_equal(other.standard_error, whole.standard_error)
        assert other.provenance["evaluations"] == whole.provenance["evaluations"]


def test_minutes_buy_smaller_errors() -> None:
    mesh = icosphere(1)
    asset = bake(Lobed(), mesh, rings=8, sectors=32, minutes=0.03)
    rows = asset.error_vs_time
    assert len(rows) >= 2
    assert (np.diff(rows[:, :2], axis=0) > 0).all()
    assert rows[-1, 2] < 0.3 * rows[0, 2]
    assert asset.provenance["estimated_relative_rmse"]["total"] == rows[-1, 2]


def test_what_is_asked_for_must_make_sense() -> None:
    mesh = icosphere(0)
    with pytest.raises(QueryError, match="out of reach"):
        bake(Incoherent(), mesh, rings=1, sectors=1, error=1e-7)
    with pytest.raises(QueryError, match="between 0 and 1"):
        bake(Lobed(), mesh, error=0.0)
    with pytest.raises(QueryError, match="minutes"):
        bake(Lobed(), mesh, minutes=-1.0)
    with pytest.raises(QueryError, match="minutes"):
        bake(Lobed(), mesh, directions="sobol", minutes=1.0)
    with pytest.raises(QueryError, match="resume"):
        bake(Lobed(), mesh, resume=True)
