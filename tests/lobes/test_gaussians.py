"""Gaussians less their harmonics, compared with quadrature."""

import math

import numpy as np
import pytest

from prt_bake.lobes.gaussians import beyond_harmonics
from prt_bake.lobes.interpolation import amplitude_of, power_of
from prt_bake.mathematics import sh


@pytest.mark.parametrize("degree", [0, 1, 2, 5])
@pytest.mark.parametrize("sharpness", [1e-3, 0.3, 4.0, 60.0, 300.0])
def test_a_gaussian_has_no_harmonics_left(sharpness: float, degree: int) -> None:
    cosine, weight = np.polynomial.legendre.leggauss(400)
    values = np.array([beyond_harmonics(c, sharpness, degree) for c in cosine])
    for band in range(degree + 4):
        moment = 2.0 * math.pi * (weight * values * np.polynomial.legendre.Legendre.basis(band)(cosine)).sum()
        expected = (
            weight * np.exp(sharpness * (cosine - 1.0)) * np.polynomial.legendre.Legendre.basis(band)(cosine)
        ).sum()
        expected /= (weight * np.exp(sharpness * (cosine - 1.0))).sum()
        assert moment == pytest.approx(0.0 if band <= degree else expected, abs=2e-4)


@pytest.mark.parametrize("sharpness", [1e-6, 0.3, 30.0, 3000.0])
def test_power_is_the_integral(sharpness: float) -> None:
    assert amplitude_of(power_of(2.0, sharpness), sharpness) == pytest.approx(2.0, rel=1e-12)
    directions, weights = sh.quadrature(40)
    if sharpness <= 30.0:
        integral = (weights * np.exp(sharpness * (directions[:, 2] - 1.0))).sum()
        assert power_of(1.0, sharpness) == pytest.approx(integral, rel=1e-9)
