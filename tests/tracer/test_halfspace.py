"""Thick isotropic media compared with the exact theory of half spaces and slabs.

z-tests at `significance.FALSE_ALARM` for all values of a test together.
"""

from pathlib import Path

import numpy as np
import pytest

from formats.scene import Scene
from prt_bake import estimate_coefficients, estimate_transport
from tests.mathematics.significance import assert_agree
from tests.tracer.half_space import h_function, reflected, white_sky
from tests.tracer.scenes import make_scene, slab

pytestmark = pytest.mark.statistics

ALBEDOS = (0.5, 0.9, 0.99)
COSINES = np.array([0.05, 0.2, 0.5, 0.8, 1.0])
EXTRAPOLATION = 0.7104460896
"""Milne's extrapolation length of conservative isotropic media, in mean free paths."""


def wide(folder: Path, thickness: float, albedo: object) -> Scene:
    """A slab of height 1, so wide that light around its rim is negligible."""
    return make_scene(folder, slab(40.0), sigma_t=thickness, albedo=albedo)


def upwards(cosines: np.ndarray, seed: int) -> np.ndarray:
    """Directions [N,3] at these cosines with +z and random azimuth."""
    turn = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(cosines))
    sine = np.sqrt(1.0 - cosines**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosines], axis=1)


def middle(count: int) -> np.ndarray:
    """Points on the upper side [N,3], none on an edge between triangles."""
    return np.stack([np.linspace(0.1, 0.4, count), np.full(count, -0.3), np.full(count, 0.5)], axis=1)


def test_h_function_has_its_tabulated_values() -> None:
    """Chandrasekhar, Radiative Transfer, table XI; and the mean, ∫ H dμ = 2 (1 − √(1 − a)) / a."""
    np.testing.assert_allclose(h_function(1.0, [0.0, 0.5, 1.0]), [1.0, 2.0128, 2.9078], atol=2e-4)
    x, w = np.polynomial.legendre.leggauss(100)
    for albedo in ALBEDOS:
        mean = np.sum(0.5 * w * h_function(albedo, 0.5 * (x + 1.0)))
        np.testing.assert_allclose(mean, 2.0 * (1.0 - np.sqrt(1.0 - albedo)) / albedo, rtol=1e-5)


def test_half_space_under_a_white_sky(tmp_path: Path) -> None:
    """∫ Ŝ dωi = 1 − √(1 − a) H(μo), by exits."""
    scene = wide(tmp_path, 200.0, ALBEDOS)
    result = estimate_coefficients(scene, middle(len(COSINES)), upwards(COSINES, 1), 0, 10_000, 3)
    root = np.sqrt(4.0 * np.pi)
    expected = np.stack([white_sky(albedo, COSINES) for albedo in ALBEDOS], axis=1)
    assert_agree(root * result.mean[:, 0], root * result.standard_error[:, 0], expected)
    assert (root * result.standard_error[:, 0] < 0.01).all()


def test_half_space_between_pairs_of_directions(tmp_path: Path) -> None:
    """Ŝ = a/4π · μi/(μi + μo) · H(μo) H(μi) for every pair of cosines; 0 for light from below."""
    scene = wide(tmp_path, 200.0, ALBEDOS)
    mu_o, mu_i = (grid.ravel() for grid in np.meshgrid(COSINES, [0.1, 0.6, 0.95], indexing="ij"))
    incident = upwards(mu_i, 2)
    both_sides = np.stack([incident, incident * [1.0, 1.0, -1.0]], axis=1)
    result = estimate_transport(scene, middle(len(mu_o)), upwards(mu_o, 1), both_sides, 6_000, 3, connections=2)
    expected = np.stack([reflected(albedo, mu_o, mu_i) for albedo in ALBEDOS], axis=1)
    assert_agree(result.mean[:, 0], result.standard_error[:, 0], expected)
    assert (result.standard_error[:, 0] < 0.06 * expected).all()
    assert (result.mean[:, 1] < 1e-9).all()


def test_nearly_white_half_space(tmp_path: Path) -> None:
    """Albedo 0.999: hundreds of events per walk, and a diffusion length of 18 mean free paths."""
    scene = wide(tmp_path, 500.0, 0.999)
    cosines = np.array([0.2, 0.6, 1.0])
    result = estimate_coefficients(scene, middle(3), upwards(cosines, 1), 0, 12_000, 3)
    root = np.sqrt(4.0 * np.pi)
    assert_agree(root * result.mean[:, 0, 1], root * result.standard_error[:, 0, 1], white_sky(0.999, cosines))
    assert (root * result.standard_error[:, 0] < 5e-3).all()


@pytest.mark.parametrize("thickness", [8.0, 25.0])
def test_transmission_of_a_thick_white_slab(tmp_path: Path, thickness: float) -> None:
    """Ŝ = μi/π · H(μo) H(μi) / (4 (τ + 2q)), q Milne's extrapolation length; corrections fall as exp(−τ)."""
    scene = wide(tmp_path, thickness, 1.0)
    mu_o, mu_i = np.array([0.15, 0.5, 0.9, 1.0]), np.array([0.9, 0.3, 0.6, 1.0])
    incident = upwards(mu_i, 2) * [1.0, 1.0, -1.0]
    result = estimate_transport(scene, middle(4), upwards(mu_o, 1), incident, int(2e5 / thickness), 3)
    expected = mu_i / np.pi * h_function(1.0, mu_o) * h_function(1.0, mu_i) / (4.0 * (thickness + 2.0 * EXTRAPOLATION))
    assert_agree(result.mean[:, 1], np.hypot(result.standard_error[:, 1], np.exp(-thickness) * expected), expected)
    assert (result.standard_error[:, 1] < 0.1 * expected).all()
