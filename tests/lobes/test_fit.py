"""Lobes fitted to Gaussians that are known, and their interpolation between nodes."""

import numpy as np
import pytest

from formats.asset.lobes import Lobes
from prt_bake.lobes.fit import LobeFit
from prt_bake.lobes.interpolation import lobes_at, power_of
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import fibonacci, random_rotations

RINGS, SECTORS = 2, 4
VIEWS = sphere.view_bins(2 * RINGS, SECTORS)
SETS = np.arange(len(VIEWS)) % 3
POOL = np.stack([fibonacci(160) @ turn.T for turn in random_rotations(3, 1)])
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
COLOUR = np.array([1.0, -0.5, 0.25])


def values_of(sharpness: float, degree: int) -> np.ndarray:
    """A Gaussian beside random harmonics, in all views of one vertex [1,B,D,3]."""
    towards = POOL[SETS]
    harmonics = sh.evaluate(towards, degree) @ np.random.default_rng(0).normal(size=(sh.count(degree), 3))
    return np.asarray((np.exp(sharpness * (towards @ AXIS - 1.0))[..., None] * COLOUR + harmonics)[None])


@pytest.mark.parametrize("degree", [0, 2, 4])
@pytest.mark.parametrize("sharpness", [6.0, 11.0, 40.0])
def test_a_gaussian_is_found_exactly(sharpness: float, degree: int) -> None:
    fit = LobeFit(RINGS, SECTORS, VIEWS, SETS, POOL, degree, 66.0)
    rest = fit.beyond_harmonics(values_of(sharpness, degree))
    before = rest.copy()
    field = fit.add(rest)
    np.testing.assert_allclose(field.axes, np.broadcast_to(AXIS, field.axes.shape), atol=2e-3)
    np.testing.assert_allclose(field.sharpness, sharpness, rtol=0.01)
    np.testing.assert_allclose(field.powers[0, 0], COLOUR * power_of(1.0, sharpness), rtol=0.01)
    assert np.abs(rest).max() <= 0.01 * np.abs(before).max()
    fit.subtract(field, rest, -1.0)
    np.testing.assert_allclose(rest, before, atol=1e-5)


def test_harmonics_leave_nothing() -> None:
    fit = LobeFit(RINGS, SECTORS, VIEWS, SETS, POOL, 2, 66.0)
    values = values_of(6.0, 2) - np.exp(6.0 * (POOL[SETS] @ AXIS - 1.0))[None, ..., None] * COLOUR
    rest = fit.beyond_harmonics(values)
    assert np.abs(rest).max() <= 1e-5 * np.abs(values).max()
    assert np.abs(fit.add(np.zeros_like(rest)).powers).max() == 0.0


def nodes(powers: np.ndarray, sharpness: np.ndarray, axes: np.ndarray) -> Lobes:
    parts = (part[None, :, None].astype(np.float32) for part in (axes, sharpness, powers))
    return Lobes(RINGS, SECTORS, *parts)


def test_lobes_between_nodes() -> None:
    draw = np.random.default_rng(1)
    count, centres = RINGS * SECTORS, sphere.view_bins(RINGS, SECTORS)
    axes = draw.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    powers, sharpness = draw.normal(size=(count, 3)), draw.uniform(3.0, 60.0, count)
    lobes = nodes(powers, sharpness, axes)
    ring_1 = slice(SECTORS, 2 * SECTORS)
    found = lobes_at(lobes, np.zeros(SECTORS, np.int64), centres[ring_1])
    np.testing.assert_allclose(found.powers[:, 0], powers[ring_1], rtol=1e-5)
    np.testing.assert_allclose(found.axes[:, 0], axes[ring_1], atol=1e-5)
    np.testing.assert_allclose(found.sharpness[:, 0], sharpness[ring_1], rtol=1e-5)
    pole = lobes_at(lobes, np.zeros(1, np.int64), np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(pole.powers[0, 0], powers[:SECTORS].mean(axis=0), rtol=1e-5)


def test_a_node_without_power_does_not_turn_its_neighbours() -> None:
    powers, sharpness = np.zeros((RINGS * SECTORS, 3)), np.full(RINGS * SECTORS, 50.0)
    axes = np.tile([0.0, 0.0, 1.0], (RINGS * SECTORS, 1))
    powers[5], sharpness[5], axes[5] = 2.0, 7.0, [1.0, 0.0, 0.0]
    between = sphere.view_bins(RINGS, SECTORS)[[5, 6]].sum(axis=0)
    found = lobes_at(nodes(powers, sharpness, axes), np.zeros(1, np.int64), between[None] / np.linalg.norm(between))
    assert 0.5 < found.powers[0, 0, 0] < 1.5
    np.testing.assert_allclose(found.axes[0, 0], [1.0, 0.0, 0.0], atol=1e-6)
    assert found.sharpness[0, 0] == pytest.approx(7.0)
    nothing = lobes_at(nodes(0.0 * powers, sharpness, axes), np.zeros(1, np.int64), between[None])
    assert nothing.sharpness[0, 0] == 0.0
