"""Maximum-entropy reconstruction: its properties, and extreme coefficients."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from prt_bake.mathematics import sh, sphere
from prt_bake.shading.maximum_entropy import RIDGE, SCALE, fit_maximum_entropy, radiance_gradient

FINE, WEIGHTS = sh.quadrature(40)


def moments_of(values: np.ndarray, degree: int = 2) -> np.ndarray:
    """Coefficients [n,K,C] of functions [n,C,D] at the fine quadrature's directions."""
    return np.einsum("ncd,d,dk->nkc", values, WEIGHTS, sh.evaluate(FINE, degree))


def lobes(sharpness=1.5, count=20, channels=3) -> np.ndarray:
    """Positive functions [n,C,D]: exponentials of random quadratics."""
    exponent = sharpness * np.random.default_rng(4).normal(size=(count, channels, 9))
    return np.exp(exponent @ sh.evaluate(FINE, 2).T)


def test_energy_is_kept_and_other_coefficients_deviate_by_the_ridge() -> None:
    """The deviation is the ridge times the multipliers."""
    wanted = moments_of(lobes())
    fitted = fit_maximum_entropy(wanted)
    found = moments_of(fitted.evaluate(FINE))
    assert (fitted.evaluate(FINE) > 0.0).all()
    np.testing.assert_allclose(found[:, 0], wanted[:, 0], rtol=1e-5)
    off = (found - wanted)[:, 1:].transpose(0, 2, 1) / fitted.energy[..., None]
    price = RIDGE * (1.0 + (fitted.multipliers**2).sum(axis=2, keepdims=True) / SCALE**2)
    np.testing.assert_allclose(off, -price * fitted.multipliers, atol=2e-5)


def test_exponentials_of_quadratics_are_recovered() -> None:
    """The reconstruction is exact for this family, except for the ridge."""
    truth = lobes(0.7)
    found = fit_maximum_entropy(moments_of(truth)).evaluate(FINE)
    assert np.sqrt(((found - truth) ** 2).sum() / (truth**2).sum()) < 0.01


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_constant_transport_is_constant(degree: int) -> None:
    coefficients = np.zeros((2, sh.count(degree), 3))
    coefficients[:, 0] = [[1.0, 2.0, 3.0], [1e-30, 1e30, 5.0]]
    found = fit_maximum_entropy(coefficients).evaluate(LATTICE)
    np.testing.assert_allclose(found, np.repeat(coefficients[:, 0, :, None] / math.sqrt(4 * math.pi), 7, 2), rtol=1e-9)


LATTICE = sphere.fibonacci(7)


def test_multipliers_equal_those_of_a_generic_minimiser() -> None:
    nodes, weights = sh.quadrature(12)
    harmonics = sh.evaluate(nodes, 2)[:, 1:]
    for row in moments_of(lobes(count=3, channels=1)):
        means = row[1:, 0] / (row[0, 0] * math.sqrt(4 * math.pi))

        def dual(x: np.ndarray, means: np.ndarray = means) -> float:
            return float(
                np.log(weights @ np.exp(harmonics @ x))
                - means @ x
                + 0.5 * RIDGE * x @ x * (1.0 + 0.5 * x @ x / SCALE**2)
            )

        found = fit_maximum_entropy(row[None]).multipliers[0, 0]
        np.testing.assert_allclose(found, minimize(dual, np.zeros(8), tol=1e-12).x, atol=2e-4)


def test_the_reconstruction_rotates_and_scales_with_the_coefficients() -> None:
    coefficients, turn = moments_of(lobes()), sphere.random_rotations(1, 2)[0]
    still = fit_maximum_entropy(coefficients).evaluate(FINE)
    turned = fit_maximum_entropy(np.einsum("jk,nkc->njc", sh.rotation(turn, 2), coefficients))
    np.testing.assert_allclose(turned.evaluate(FINE @ turn.T), still, rtol=1e-3)
    np.testing.assert_allclose(fit_maximum_entropy(1e-12 * coefficients).evaluate(FINE), 1e-12 * still, rtol=1e-6)


@pytest.mark.parametrize("axis", [*np.eye(3), -np.eye(3)[2], np.array([0.48, 0.6, 0.64])])
def test_coefficients_of_no_positive_function_give_a_narrow_lobe(axis: np.ndarray) -> None:
    """A delta function, and coefficients beyond it, as of noise and clear objects."""
    needle = sh.evaluate(axis, 2)[None, :, None]
    beyond = needle * np.array([1.0, *[1.5] * 3, *[2.0] * 5])[:, None]
    for coefficients in (needle, beyond):
        fitted = fit_maximum_entropy(coefficients)
        values = fitted.evaluate(FINE)
        assert np.isfinite(values).all()
        assert values[0, 0] @ WEIGHTS == pytest.approx(1.0, rel=0.03)
        assert fitted.evaluate(axis[None])[0, 0, 0] > 5.0 * 9.0 / (4.0 * math.pi) / 2.0
        assert values[0, 0, FINE @ axis < 0.0].max() < 2e-2


def test_noise_of_any_scale_has_a_solution() -> None:
    coefficients = np.random.default_rng(1).normal(size=(300, 9, 3)) * np.geomspace(1e-20, 1e20, 300)[:, None, None]
    values = fit_maximum_entropy(coefficients).evaluate(LATTICE)
    assert np.isfinite(values).all()
    assert ((values >= 0.0).all(axis=2) == (coefficients[:, 0] > 0.0)).all()


def test_negative_energy_gives_a_constant_and_zero_gives_zero() -> None:
    coefficients = np.zeros((2, 9, 1))
    coefficients[1, :, 0] = [-1.0, *[0.3] * 8]
    values = fit_maximum_entropy(coefficients).evaluate(LATTICE)
    np.testing.assert_allclose(values[0], 0.0, atol=0.0)
    np.testing.assert_allclose(values[1], -1.0 / math.sqrt(4.0 * math.pi), rtol=1e-12)


def test_narrow_transport_is_closer_than_its_harmonics() -> None:
    """A lobe of forward scattering."""
    truth = np.exp(6.0 * (FINE @ np.array([0.48, 0.6, 0.64]) - 1.0))[None, None]
    coefficients = moments_of(truth)
    ours = fit_maximum_entropy(coefficients).evaluate(FINE)
    theirs = np.einsum("dk,nkc->ncd", sh.evaluate(FINE, 2), coefficients)
    errors = [math.sqrt(float(((answer - truth) ** 2 @ WEIGHTS)[0, 0])) for answer in (ours, theirs)]
    assert errors[0] < 0.2 * errors[1]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_gradient_equals_differences_of_fits(degree: int) -> None:
    """For soft and narrow transport, for coefficients of no positive function, and for a negative mean."""
    rng = np.random.default_rng(5)
    directions, irradiance = sphere.fibonacci(2), rng.uniform(0.5, 2.0, (2, 3))
    soft = moments_of(lobes(0.7, 3), degree)
    # Slightly below the bound at which m is clamped, since the gradient jumps there.
    needle = np.repeat(sh.evaluate(sphere.fibonacci(3), degree)[..., None], 3, axis=2)
    needle *= np.where(np.arange(soft.shape[1]) > 0, 0.95, 1.0)[:, None]
    beyond = soft * np.where(np.arange(soft.shape[1]) > 0, 4.0, 1.0)[:, None]
    coefficients = np.concatenate([soft, needle, beyond, -soft[:1], 1e-12 * soft[:1], 1e9 * soft[:1]])

    def radiance(numbers: np.ndarray) -> np.ndarray:
        return np.einsum("ncd,dc->nc", fit_maximum_entropy(numbers).evaluate(directions), irradiance)

    found = radiance_gradient(coefficients, fit_maximum_entropy(coefficients), directions, irradiance)
    step = 1e-5 * np.abs(coefficients[:, :1])
    for k in range(coefficients.shape[1]):
        moved = step * (np.arange(coefficients.shape[1]) == k)[:, None]
        by_fits = (radiance(coefficients + moved) - radiance(coefficients - moved)) / (2.0 * step[:, 0])
        scale = np.linalg.norm(found, axis=1)
        assert (np.abs(found[:, k] - by_fits) < 1e-3 * scale + 1e-9).all(), k
