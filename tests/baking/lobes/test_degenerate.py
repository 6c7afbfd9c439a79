"""Lobes of transports at the limits: narrow, at the pole, grazing, behind, crossing, negative; degree 0; one view."""

import numpy as np
import pytest

import prt_bake as prt
from tests.baking.lobes.transports import MESH, Array, Axes, Lobed, along_normal, bent, errors, mirrored, towards


def behind(normals: Array, outgoing: Array) -> Array:
    return -normals


def across(normals: Array, outgoing: Array) -> Array:
    """A tangent, away from the eye."""
    flat = -outgoing + (outgoing * normals).sum(axis=1, keepdims=True) * normals
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9))


def turning(sign: float) -> Axes:
    """An axis that turns with the view; those of both signs cross where the view is the normal."""

    def axes(normals: Array, outgoing: Array) -> Array:
        axis = normals + sign * (outgoing - normals)
        return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))

    return axes


CASES = {
    "at the pole": (Lobed(((along_normal, 8.0, 1.0),)), 0.0),
    "behind the horizon": (Lobed(((behind, 8.0, 1.0),)), 0.3),
    "grazing": (Lobed(((across, 8.0, 1.0),)), 0.8),
    "seen at grazing angles": (Lobed(), 0.95),
    "two that cross": (Lobed(((turning(1.0), 14.0, 1.0), (turning(-1.0), 14.0, 1.0))), 0.4),
    "negative": (Lobed(((mirrored, 8.0, -0.9),), constant=1.0), 0.4),
}


@pytest.mark.parametrize("case", CASES)
def test_lobes_take_most_of_the_error(case: str) -> None:
    transport, sine = CASES[case]
    asset = prt.bake(transport, MESH, rings=16, sectors=64, samples=64, lobes=4)
    assert asset.lobes is not None
    without, found = errors(transport, asset, towards(sine))
    assert found <= 0.4 * without


def test_a_lobe_narrower_than_the_directions_does_no_harm() -> None:
    transport = Lobed(((mirrored, 3000.0, 5.0),), constant=0.5)
    asset = prt.bake(transport, MESH, rings=8, sectors=16, samples=64, lobes=4)
    without, found = errors(transport, asset, towards(0.4))
    assert found <= 1.05 * without


@pytest.mark.parametrize("degree", [0, 1, 5, 7])
def test_any_degree_has_lobes(degree: int) -> None:
    transport = Lobed(((along_normal, 40.0, 1.0),))
    asset = prt.bake(transport, MESH, degree=degree, rings=4, sectors=8, samples=256, lobes=4)
    assert asset.lobes is not None
    without, found = errors(transport, asset, towards(0.4), 6)
    assert found <= 0.3 * without


def test_one_view_bin_has_one_node() -> None:
    transport = Lobed(((along_normal, 8.0, 1.0),))
    asset = prt.bake(transport, MESH, rings=1, sectors=1, samples=64, lobes=4)
    assert asset.lobes is not None
    assert asset.lobes.axes.shape[1] == 1
    without, found = errors(transport, asset, towards(0.5))
    assert found <= 0.3 * without


def test_radiance_of_extreme_size_has_the_same_lobes() -> None:
    small, large = (Lobed(((bent, 12.0, size),), constant=0.1 * size) for size in (1e-30, 1e30))
    tiny, huge = (prt.bake(transport, MESH, rings=2, sectors=8, lobes=4).lobes for transport in (small, large))
    assert tiny is not None
    assert huge is not None
    np.testing.assert_allclose(tiny.axes, huge.axes, atol=1e-4)
    np.testing.assert_allclose(tiny.powers / 1e-30, huge.powers / 1e30, rtol=1e-3, atol=1e-4)
