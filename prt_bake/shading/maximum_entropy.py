"""Maximum-entropy reconstruction of transport from a few harmonics: positive, without ringing.

A vertex seen from one direction has the coefficients a_k = ∫ f Y_k dω of its transport f(ωi) ≥ 0. The polynomial
Σ a_k Y_k is the function of least square with these coefficients. It is fine under a sky but rings under a light from
one direction, such as a sun. The function of maximum entropy −∫ f ln f dω is f = exp(Σ μ_k Y_k). It is positive, and
much closer to narrow transport such as forward scattering and clear objects.

With p = f / ∫ f and m_k = a_k / ∫ f, ∫ f = √(4π) a_00, the multipliers λ_k, k ≥ 1, minimise the dual

    ln ∫ exp(Σ λ_k Y_k) dω − Σ λ_k m_k + ½ ρ |λ|² (1 + |λ|² / 2Λ²).

It is strictly convex with the gradient ⟨Y_k⟩_p − m_k + ρ λ_k (1 + |λ|²/Λ²), so damped Newton steps always converge.
Coefficients that no positive function has (noise, network errors) have a solution too, because ρ > 0. The quadrature
resolves it, because the penalty rises fast beyond Λ. The energy ∫ f is exact up to the quadrature (1e-6 except for
needles); the other coefficients deviate by the last term of the gradient times ∫ f. Sources: Jaynes, "Information
Theory and Statistical Mechanics", Phys. Rev. 106 (1957); Mead and Papanicolaou, "Maximum entropy in the problem of
moments", J. Math. Phys. 25 (1984), for the convex dual.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads
from prt_bake.mathematics import sh

Array = NDArray[np.float64]

RIDGE = 3e-4
"""ρ in the module's docstring."""
SCALE = 6.0
"""Λ in the module's docstring; multipliers of needles stay below about 40."""
_QUADRATURE = 10
_MAX_STEPS = 60
_TOLERANCE = 1e-9
"""Largest entry of the gradient at which Newton's method ends."""


@dataclass(frozen=True)
class MaximumEntropyTransport:
    """f [n,C] as energy · exp(Σ λ_k Y_k − logarithm): energy, logarithm [n,C], multipliers λ [n,C,K−1], k from 1."""

    energy: Array
    logarithm: Array
    multipliers: Array

    def evaluate(self, directions: ArrayLike) -> Array:
        """f [n,C,D] for light from unit `directions` [D,3]."""
        degree = sh.degree_of(self.multipliers.shape[2] + 1)
        exponent = self.multipliers @ sh.evaluate(directions, degree)[:, 1:].T - self.logarithm[..., None]
        return np.asarray(self.energy[..., None] * np.exp(exponent))


def fit_maximum_entropy(coefficients: ArrayLike) -> MaximumEntropyTransport:
    """The maximum-entropy functions with `coefficients` [n,K,C], K = (degree + 1)².

    If a_00 is not positive there is no positive function, and the constant function of that energy is returned. The
    functions are independent of the light, and scale and rotate with the coefficients.
    """
    values = np.asarray(coefficients, np.float64)
    degree = sh.degree_of(values.shape[1])
    energy, means = _means(values)
    for band, bound in _bands(means):
        band *= (bound / np.maximum(np.linalg.norm(band, axis=1), bound))[:, None]
    multipliers, logarithm = np.zeros(means.shape), np.full(len(means), math.log(4.0 * math.pi))
    if degree > 0:
        in_threads(_fit, len(means), means, *_tables(degree), (RIDGE, SCALE), multipliers, logarithm)
    shape = (len(values), values.shape[2])
    return MaximumEntropyTransport(energy.reshape(shape), logarithm.reshape(shape), multipliers.reshape(*shape, -1))


def radiance_gradient(
    coefficients: ArrayLike, transport: MaximumEntropyTransport, directions: ArrayLike, irradiance: ArrayLike
) -> Array:
    """∂/∂a_k [n,K,C] of the radiance Σ_d f(ω_d) E_d of a `transport` fitted to `coefficients` [n,K,C].

    directions [D,3], irradiance [D,C]: of the suns. By the implicit function theorem: the gradient of the dual stays 0,
    so its Hessian gives the derivative of the multipliers by m.
    """
    values = np.asarray(coefficients, np.float64)
    degree, (count, _, channels) = sh.degree_of(values.shape[1]), values.shape
    energy, means = _means(values)
    # Contiguous and writable copies, whatever the number of suns and channels: kernels are compiled for each layout.
    harmonics = sh.evaluate(directions, degree)[:, 1:].copy()
    gradient, radiance = np.zeros(means.shape), np.empty(len(means))
    multipliers, logarithm = np.array(transport.multipliers).reshape(means.shape), transport.logarithm.flatten()
    suns = np.ascontiguousarray(
        np.broadcast_to(np.asarray(irradiance, np.float64).T, (count, channels, len(harmonics)))
    ).reshape(len(means), -1)
    price = (RIDGE, SCALE)
    in_threads(
        _follow, len(means), multipliers, logarithm, harmonics, suns, *_tables(degree), price, gradient, radiance
    )
    for band, raw in zip(_bands(gradient), _bands(means), strict=True):
        _project_clamped(band[0], *raw)
    gradient[energy <= 0.0] = 0.0
    by_energy = math.sqrt(4.0 * math.pi) * (radiance - np.einsum("nk,nk->n", gradient, means))
    derivatives = np.concatenate([by_energy[:, None], gradient], axis=1)
    return np.asarray(derivatives.reshape(count, channels, -1).transpose(0, 2, 1))


def _means(coefficients: Array) -> tuple[Array, Array]:
    """∫ f [M] and m [M,K−1] of the rows of all vertices and channels; m is 0 if ∫ f is not positive."""
    rows = coefficients.transpose(0, 2, 1).reshape(-1, coefficients.shape[1])
    energy = math.sqrt(4.0 * math.pi) * rows[:, 0]
    means = np.zeros((len(rows), rows.shape[1] - 1))
    return energy, np.divide(rows[:, 1:], energy[:, None], out=means, where=(energy > 0.0)[:, None])


def _bands(means: Array) -> Iterator[tuple[Array, float]]:
    """Views [M,2l+1] of m by degree, and their norm for a delta function, which bounds all positive functions."""
    for l in range(1, sh.degree_of(means.shape[1] + 1) + 1):
        yield means[:, l * l - 1 : (l + 1) ** 2 - 1], math.sqrt((2 * l + 1) / (4.0 * math.pi))


def _project_clamped(gradient: Array, band: Array, bound: float) -> None:
    """Turn a gradient [M,2l+1] by the clamped band into one by the `band` before clamping to the norm `bound`."""
    length = np.linalg.norm(band, axis=1)
    beyond = length > bound
    unit = band[beyond] / length[beyond, None]
    tangential = gradient[beyond] - np.einsum("mk,mk->m", gradient[beyond], unit)[:, None] * unit
    gradient[beyond] = tangential * (bound / length[beyond])[:, None]


@cache
def _tables(degree: int) -> tuple[Array, Array]:
    """Harmonics [K−1,D] of degree 1 and more at the nodes of a quadrature, and its weights [D]."""
    directions, weights = sh.quadrature(max(_QUADRATURE, 5 * degree))
    return np.ascontiguousarray(sh.evaluate(directions, degree)[:, 1:].T), weights


@compiled(nogil=True)
def _fit(
    first: Any, stop: Any, means: Any, harmonics: Any, weights: Any, price: Any, multipliers: Any, logarithm: Any
) -> None:
    """Set the multipliers [M,K−1] and logarithm [M] of the rows `first` to `stop` by damped Newton steps."""
    unknowns, nodes = harmonics.shape
    for n in range(first, stop):
        density, gradient, hessian = np.empty(nodes), np.empty(unknowns), np.empty((unknowns, unknowns))
        found, trial = np.zeros(unknowns), np.empty(unknowns)
        value, logarithm[n] = _dual(found, means[n], harmonics, weights, price, density)
        for _ in range(_MAX_STEPS):
            steepest = _derivatives(found, means[n], harmonics, price, density, gradient, hessian)
            if steepest < _TOLERANCE:
                break
            slope = _solve(hessian, gradient)
            step, better = 1.0, False
            while step > 1e-6 and not better:
                for k in range(unknowns):
                    trial[k] = found[k] - step * gradient[k]
                reached, total = _dual(trial, means[n], harmonics, weights, price, density)
                better = reached <= value - 0.1 * step * slope
                step *= 0.5
            if not better:
                break
            found[:], value, logarithm[n] = trial, reached, total
        multipliers[n] = found


@compiled(nogil=True)
def _follow(
    first: Any,
    stop: Any,
    multipliers: Any,
    logarithm: Any,
    sun_harmonics: Any,
    irradiance: Any,
    harmonics: Any,
    weights: Any,
    price: Any,
    by_means: Any,
    radiance: Any,
) -> None:
    """Set `radiance` [M] to Σ_d f E_d / ∫ f, and `by_means` [M,K−1] to its derivative by m."""
    unknowns, nodes = harmonics.shape
    for n in range(first, stop):
        density, gradient, hessian = np.empty(nodes), np.zeros(unknowns), np.empty((unknowns, unknowns))
        found, change = multipliers[n], by_means[n]
        _dual(found, gradient, harmonics, weights, price, density)
        _derivatives(found, gradient, harmonics, price, density, gradient, hessian)
        total = 0.0
        for d in range(sun_harmonics.shape[0]):
            exponent = -logarithm[n]
            for k in range(unknowns):
                exponent += found[k] * sun_harmonics[d, k]
            received = irradiance[n, d] * math.exp(exponent)
            total += received
            for k in range(unknowns):
                change[k] += received * sun_harmonics[d, k]
        radiance[n] = total
        for k in range(unknowns):
            for d in range(nodes):
                change[k] -= total * density[d] * harmonics[k, d]
        _solve(hessian, change)


@compiled(fastmath=True)
def _dual(found: Any, means: Any, harmonics: Any, weights: Any, price: Any, density: Any) -> Any:
    """The dual and the logarithm in it; sets `density` [D] to p times the weights."""
    unknowns, nodes = harmonics.shape
    density[:] = 0.0
    linear, square = 0.0, 0.0
    for k in range(unknowns):
        linear += found[k] * means[k]
        square += found[k] * found[k]
        for d in range(nodes):
            density[d] += found[k] * harmonics[k, d]
    largest = density[0]
    for d in range(nodes):
        largest = max(largest, density[d])
    total = 0.0
    for d in range(nodes):
        density[d] = weights[d] * math.exp(density[d] - largest)
        total += density[d]
    for d in range(nodes):
        density[d] /= total
    ridge, scale = price
    logarithm = largest + math.log(total)
    return logarithm - linear + 0.5 * ridge * square * (1.0 + 0.5 * square / (scale * scale)), logarithm


@compiled(fastmath=True)
def _derivatives(found: Any, means: Any, harmonics: Any, price: Any, density: Any, gradient: Any, hessian: Any) -> Any:
    """Set the gradient and the Hessian of the dual; returns the gradient's largest entry."""
    unknowns, nodes = harmonics.shape
    mean, weighted = np.empty(unknowns), np.empty(nodes)
    ridge, scale = price
    bend = 2.0 * ridge / (scale * scale)
    slope = ridge
    for k in range(unknowns):
        slope += 0.5 * bend * found[k] * found[k]
    steepest = 0.0
    for j in range(unknowns):
        total = 0.0
        for d in range(nodes):
            weighted[d] = density[d] * harmonics[j, d]
            total += weighted[d]
        mean[j] = total
        gradient[j] = total - means[j] + slope * found[j]
        steepest = max(steepest, abs(gradient[j]))
        for k in range(j + 1):
            product = 0.0
            for d in range(nodes):
                product += weighted[d] * harmonics[k, d]
            hessian[j, k] = product - mean[j] * mean[k] + bend * found[j] * found[k]
        hessian[j, j] += slope
    return steepest


@compiled()
def _solve(hessian: Any, gradient: Any) -> Any:
    """Replace `gradient` by the Newton step, by a Cholesky factorisation in place; returns gradient · step."""
    unknowns = gradient.shape[0]
    slope = 0.0
    for j in range(unknowns):
        for k in range(j + 1):
            left = hessian[j, k]
            for i in range(k):
                left -= hessian[j, i] * hessian[k, i]
            hessian[j, k] = math.sqrt(max(left, 1e-300)) if j == k else left / hessian[k, k]
        left = gradient[j]
        for i in range(j):
            left -= hessian[j, i] * gradient[i]
        gradient[j] = left / hessian[j, j]
        slope += gradient[j] * gradient[j]
    for j in range(unknowns - 1, -1, -1):
        left = gradient[j]
        for i in range(j + 1, unknowns):
            left -= hessian[i, j] * gradient[i]
        gradient[j] = left / hessian[j, j]
    return slope
