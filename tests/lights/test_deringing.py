"""Deringing: the minimum is exact in every direction, and damped light is nowhere negative."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from formats.errors import QueryError
from prt_bake.lights.deringing import minimum, required_spread, windowed
from prt_bake.mathematics import sh, sphere

LATTICE = sphere.fibonacci(4000)
HARMONICS = {degree: sh.evaluate(LATTICE, degree) for degree in (1, 2, 3, 5)}
AXES = [*np.eye(3), *-np.eye(3), np.array([0.48, 0.6, 0.64])]


def lowest(function: np.ndarray) -> float:
    """The minimum by descents from the three lowest directions of a lattice."""
    degree = sh.degree_of(len(function))

    def value(d: np.ndarray) -> float:
        return float(sh.evaluate(d / np.linalg.norm(d), degree) @ function)

    starts = LATTICE[np.argsort(HARMONICS[degree] @ function)[:3]]
    return min(minimize(value, start, tol=1e-14).fun for start in starts)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_the_minimum_equals_that_of_a_search(degree: int, seed: int) -> None:
    function = np.random.default_rng(seed).normal(size=sh.count(degree))
    value, direction = minimum(function)
    assert np.linalg.norm(direction) == pytest.approx(1.0, abs=1e-14)
    assert sh.evaluate(direction, degree) @ function == pytest.approx(value, abs=1e-12)
    assert value == pytest.approx(lowest(function), abs=1e-9 if degree <= 2 else 1e-7)


@pytest.mark.parametrize("axis", AXES)
def test_the_minimum_of_degenerate_functions_is_exact(axis: np.ndarray) -> None:
    one, other = sh.evaluate(axis, 2), sh.evaluate(-axis, 2)
    l = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2])
    first, zeroth = 3.0 / (4.0 * math.pi), 1.0 / (4.0 * math.pi)
    assert minimum(one * (l < 2))[0] == pytest.approx(zeroth - first, abs=1e-14)
    assert minimum(one * (l == 1))[0] == pytest.approx(-first, abs=1e-14)
    # Opposite suns: no linear part, minimal on a great circle.
    value, direction = minimum(one + other)
    assert value == pytest.approx(2.0 * (zeroth - 2.5 / (4.0 * math.pi)), abs=1e-14)
    assert direction @ axis == pytest.approx(0.0, abs=1e-7)
    # A negative square: minimal at both ends of the axis, with and without a tiny slope.
    assert minimum(-(one + other))[0] == pytest.approx(-12.0 / (4.0 * math.pi), abs=1e-14)
    assert minimum(-(one + other) + 1e-12 * one)[0] == pytest.approx(-12.0 / (4.0 * math.pi), abs=1e-11)
    # A delta sun: −20 % of its peak, at a cosine of −0.2 (every direction of that cone is a minimum).
    value, direction = minimum(one)
    assert value == pytest.approx(-0.2 * 9.0 / (4.0 * math.pi), abs=1e-14)
    assert direction @ axis == pytest.approx(-0.2, abs=1e-7)


def test_zero_and_constant_functions() -> None:
    assert minimum(np.zeros(9))[0] == 0.0
    assert minimum([2.0])[0] == pytest.approx(2.0 / math.sqrt(4.0 * math.pi))
    assert minimum(np.eye(9)[0])[0] == pytest.approx(1.0 / math.sqrt(4.0 * math.pi))
    np.testing.assert_array_equal(windowed(np.zeros((9, 3))), np.zeros((9, 3)))


@pytest.mark.parametrize("degree", [1, 2, 4])
@pytest.mark.parametrize("axis", AXES)
def test_damped_suns_are_nowhere_negative_and_touch_zero(axis: np.ndarray, degree: int) -> None:
    light = np.outer(sh.evaluate(axis, degree), (6.0, 5.0, 1.0))
    damped = windowed(light)
    np.testing.assert_array_equal(damped[0], light[0])
    values = [minimum(channel)[0] / channel[0] for channel in damped.T]
    assert min(values) > -1e-9
    assert min(values) < 1e-7
    # Equally in all channels: no hue shift.
    np.testing.assert_allclose(damped / light[0], np.repeat(damped[:, :1] / light[0, 0], 3, axis=1), atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_any_light_is_damped_as_little_as_possible(seed: int) -> None:
    light = np.random.default_rng(seed).normal(size=(9, 3))
    light[0] = np.abs(light[0]) + 0.2
    spread = required_spread(light)
    eigenvalues = np.repeat([0.0, 2.0, 6.0], [1, 3, 5])
    least = [min(minimum(np.exp(-t * eigenvalues) * c)[0] for c in light.T) for t in (spread, 0.999 * spread)]
    assert least[0] >= -1e-9
    assert least[1] < 0.0
    np.testing.assert_allclose(windowed(7.0 * light), 7.0 * windowed(light), rtol=1e-12)
    turn = sh.rotation(sphere.random_rotations(1, seed)[0], 2)
    np.testing.assert_allclose(windowed(turn @ light), turn @ windowed(light), atol=1e-9)


def test_positive_light_is_unchanged() -> None:
    light = np.outer(sh.evaluate(AXES[1], 2), (1.0, 2.0, 3.0))
    light[0] *= 3.0
    assert required_spread(light) == 0.0
    np.testing.assert_array_equal(windowed(light), light)
    blue = light * [0.0, 0.0, 1.0]
    np.testing.assert_array_equal(windowed(blue), blue)


def test_negative_means_are_refused_and_means_of_zero_become_black() -> None:
    with pytest.raises(QueryError, match="mean radiance is negative"):
        windowed(-np.ones((9, 3)))
    hopeless = np.zeros((9, 3))
    hopeless[3] = 1.0
    np.testing.assert_array_equal(windowed(hopeless), np.zeros((9, 3)))
