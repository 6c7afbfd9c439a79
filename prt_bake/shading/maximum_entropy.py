"""Transport as a positive function of the direction of incidence, from its few harmonics: without ringing.

A vertex seen from one direction holds a_k = ∫ f Y_k dω of its transport f(ωi) ≥ 0. Of all functions with these numbers
the polynomial Σ a_k Y_k is only the one of least square; under a sky it is as good as any, but in one direction alone,
that of a sun, it rings. The one of greatest entropy −∫ f ln f dω is f = exp(Σ μ_k Y_k), positive, and of forward
scattering and of clear objects, whose transport is narrow, it is much nearer to the truth.

With p = f / ∫ f and m_k = a_k / ∫ f, ∫ f = √(4π) a_00, the multipliers λ_k, k ≥ 1, are where

    ln ∫ exp(Σ λ_k Y_k) dω − Σ λ_k m_k + ½ ρ |λ|² (1 + |λ|² / 2Λ²)

is least: a strictly convex function whose gradient is ⟨Y_k⟩_p − m_k + ρ λ_k (1 + |λ|²/Λ²), so that Newton's method with
halved steps always arrives. Coefficients that no positive function has (noise, errors of a network) have an answer too,
since ρ > 0, and one that the quadrature resolves, since beyond Λ the price rises fast. The energy ∫ f is kept (to the
error of the quadrature, 1e-6 but for needles), the other coefficients are met to the last term of the gradient times
∫ f. Sources: Jaynes, "Information Theory and Statistical Mechanics", Phys. Rev. 106 (1957); Mead and Papanicolaou,
"Maximum entropy in the problem of moments", J. Math. Phys. 25 (1984), for the convex dual.
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
"""ρ of the module's text."""
LARGE = 6.0
"""Λ of the module's text: multipliers of needles stay below some 40."""
_QUADRATURE = 10
_STEPS = 60
_CLOSE = 1e-9
"""Newton's method ends where the gradient is this small."""


@dataclass(frozen=True)
class PositiveTransport:
    """f [n,C] as energy · exp(Σ λ_k Y_k − logarithm): energy, logarithm [n,C], multipliers λ [n,C,K−1], k from 1."""

    energy: Array
    logarithm: Array
    multipliers: Array

    def towards(self, directions: ArrayLike) -> Array:
        """f [n,C,D] for light from `directions` [D,3], unit."""
        degree = sh.degree_of(self.multipliers.shape[2] + 1)
        exponent = self.multipliers @ sh.evaluate(directions, degree)[:, 1:].T - self.logarithm[..., None]
        return np.asarray(self.energy[..., None] * np.exp(exponent))


def positive_transport(coefficients: ArrayLike) -> PositiveTransport:
    """The positive functions of greatest entropy with `coefficients` [n,K,C], K = (degree + 1)².

    Where a_00 is not above 0 no function is positive, and the even one of that energy is returned. None depends on the
    light; they scale and turn with the coefficients.
    """
    numbers = np.asarray(coefficients, np.float64)
    degree = sh.degree_of(numbers.shape[1])
    energy, means = _means(numbers)
    for band, needle in _bands(means):
        band *= (needle / np.maximum(np.linalg.norm(band, axis=1), needle))[:, None]
    multipliers, logarithm = np.zeros(means.shape), np.full(len(means), math.log(4.0 * math.pi))
    if degree > 0:
        in_threads(_fit, len(means), means, *_tables(degree), (RIDGE, LARGE), multipliers, logarithm)
    shape = (len(numbers), numbers.shape[2])
    return PositiveTransport(energy.reshape(shape), logarithm.reshape(shape), multipliers.reshape(*shape, -1))


def slopes(
    coefficients: ArrayLike, transport: PositiveTransport, directions: ArrayLike, irradiance: ArrayLike
) -> Array:
    """∂/∂a_k [n,K,C] of Σ_d f(ω_d) E_d: what small errors of `coefficients` [n,K,C] make of their `transport` under
    suns in `directions` [D,3] of `irradiance` [D,C].

    By the theorem of implicit functions: the gradient of the module's text stays 0, so that its Hessian says how the
    multipliers follow m.
    """
    numbers = np.asarray(coefficients, np.float64)
    degree, (count, _, channels) = sh.degree_of(numbers.shape[1]), numbers.shape
    energy, means = _means(numbers)
    towards = sh.evaluate(directions, degree)[:, 1:]
    along, constant = np.zeros(means.shape), np.empty(len(means))
    exponents, logarithm = transport.multipliers.reshape(means.shape), transport.logarithm.ravel()
    lit = np.ascontiguousarray(np.broadcast_to(np.asarray(irradiance, np.float64).T, (count, channels, len(towards))))
    lit = lit.reshape(len(means), -1)
    in_threads(
        _follow, len(means), exponents, logarithm, towards, lit, *_tables(degree), (RIDGE, LARGE), along, constant
    )
    for band, raw in zip(_bands(along), _bands(means), strict=True):
        _hold(band[0], *raw)
    along[energy <= 0.0] = 0.0
    whole = math.sqrt(4.0 * math.pi) * (constant - np.einsum("nk,nk->n", along, means))
    found = np.concatenate([whole[:, None], along], axis=1)
    return np.asarray(found.reshape(count, channels, -1).transpose(0, 2, 1))


def _means(coefficients: Array) -> tuple[Array, Array]:
    """∫ f [M] and m [M,K−1] of the rows of all vertices and channels; 0 where ∫ f is not above 0."""
    rows = coefficients.transpose(0, 2, 1).reshape(-1, coefficients.shape[1])
    energy = math.sqrt(4.0 * math.pi) * rows[:, 0]
    means = np.zeros((len(rows), rows.shape[1] - 1))
    return energy, np.divide(rows[:, 1:], energy[:, None], out=means, where=(energy > 0.0)[:, None])


def _bands(means: Array) -> Iterator[tuple[Array, float]]:
    """Views [M,2l+1] of m by degree, and what a needle has of it, which no positive function exceeds."""
    for l in range(1, sh.degree_of(means.shape[1] + 1) + 1):
        yield means[:, l * l - 1 : (l + 1) ** 2 - 1], math.sqrt((2 * l + 1) / (4.0 * math.pi))


def _hold(slope: Array, band: Array, needle: float) -> None:
    """Make of `slope` [M,2l+1] by what was held to the needle's length the one by the `band` as it was."""
    length = np.linalg.norm(band, axis=1)
    beyond = length > needle
    unit = band[beyond] / length[beyond, None]
    across = slope[beyond] - np.einsum("mk,mk->m", slope[beyond], unit)[:, None] * unit
    slope[beyond] = across * (needle / length[beyond])[:, None]


@cache
def _tables(degree: int) -> tuple[Array, Array]:
    """Harmonics [K−1,D] from degree 1 on at the nodes of a quadrature, and its weights [D]."""
    directions, weights = sh.quadrature(max(_QUADRATURE, 5 * degree))
    return np.ascontiguousarray(sh.evaluate(directions, degree)[:, 1:].T), weights


@compiled(nogil=True)
def _fit(
    begun: Any, ended: Any, means: Any, harmonics: Any, weights: Any, price: Any, multipliers: Any, logarithm: Any
) -> None:
    unknowns, nodes = harmonics.shape
    for n in range(begun, ended):
        density, gradient, hessian = np.empty(nodes), np.empty(unknowns), np.empty((unknowns, unknowns))
        found, trial = np.zeros(unknowns), np.empty(unknowns)
        value, logarithm[n] = _dual(found, means[n], harmonics, weights, price, density)
        for _ in range(_STEPS):
            steepest = _derivatives(found, means[n], harmonics, price, density, gradient, hessian)
            if steepest < _CLOSE:
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
    begun: Any,
    ended: Any,
    multipliers: Any,
    logarithm: Any,
    towards: Any,
    irradiance: Any,
    harmonics: Any,
    weights: Any,
    price: Any,
    along: Any,
    constant: Any,
) -> None:
    """Set `along` [M,K−1] to the change of Σ_d f E_d / ∫ f with m, and `constant` [M] to that sum."""
    unknowns, nodes = harmonics.shape
    for n in range(begun, ended):
        density, gradient, hessian = np.empty(nodes), np.zeros(unknowns), np.empty((unknowns, unknowns))
        found, change = multipliers[n], along[n]
        _dual(found, gradient, harmonics, weights, price, density)
        _derivatives(found, gradient, harmonics, price, density, gradient, hessian)
        total = 0.0
        for d in range(towards.shape[0]):
            exponent = -logarithm[n]
            for k in range(unknowns):
                exponent += found[k] * towards[d, k]
            lit = irradiance[n, d] * math.exp(exponent)
            total += lit
            for k in range(unknowns):
                change[k] += lit * towards[d, k]
        constant[n] = total
        for k in range(unknowns):
            for d in range(nodes):
                change[k] -= total * density[d] * harmonics[k, d]
        _solve(hessian, change)


@compiled(fastmath=True)
def _dual(found: Any, means: Any, harmonics: Any, weights: Any, price: Any, density: Any) -> Any:
    """The function to be made least, and the logarithm in it; sets `density` [D] to p times the weights."""
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
    ridge, large = price
    logarithm = largest + math.log(total)
    return logarithm - linear + 0.5 * ridge * square * (1.0 + 0.5 * square / (large * large)), logarithm


@compiled(fastmath=True)
def _derivatives(found: Any, means: Any, harmonics: Any, price: Any, density: Any, gradient: Any, hessian: Any) -> Any:
    """Set the gradient and the Hessian; returns the gradient's largest entry."""
    unknowns, nodes = harmonics.shape
    mean, weighted = np.empty(unknowns), np.empty(nodes)
    ridge, large = price
    bend = 2.0 * ridge / (large * large)
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
    """Turn `gradient` into Newton's step, by Cholesky's factors of `hessian`'s lower half; return their product."""
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
