"""The inner loops of the fit of lobes, compiled (`fit`)."""

import math
from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled
from prt_bake.lobes.interpolation import amplitude_of, blend, power_of

_STEPS = 2
_LONGEST_TURN, _LONGEST_STRETCH = 0.3, 0.7
"""Limits of one step: radians of the axis, and the logarithm of the sharpness."""


@compiled(fastmath=True)
def _exp_of_negative(x: Any) -> Any:
    """exp(x) for x ≤ 0, at most 10⁻⁴ off: (1 + x/n + (x/n)²/2)ⁿ, n = 1024, which is computed for several x at once."""
    power = 1.0 + x / 1024.0 + 0.5 * (x / 1024.0) ** 2
    for _ in range(10):
        power *= power
    return power


@compiled(fastmath=True)
def _set_columns(axis: Any, sharpness: Any, frame: Any, towards: Any, columns: Any) -> None:
    """Set columns [4,D]: the Gaussian g, its slopes by two turns of the axis and by the logarithm of the sharpness."""
    for d in range(columns.shape[1]):
        x, y, z = towards[0, d], towards[1, d], towards[2, d]
        below = x * axis[0] + y * axis[1] + z * axis[2] - 1.0
        g = _exp_of_negative(sharpness * below)
        columns[0, d] = g
        columns[1, d] = sharpness * g * (x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2])
        columns[2, d] = sharpness * g * (x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2])
        columns[3, d] = sharpness * g * below


@compiled(fastmath=True)
def _product(first: Any, second: Any) -> Any:
    total = 0.0
    for d in range(first.shape[0]):
        total += first[d] * second[d]
    return total


@compiled()
def _gaussian_sums(
    axis: Any,
    sharpness: Any,
    frame: Any,
    around: Any,
    sample: Any,
    rest: Any,
    sums: Any,
    columns: Any,
) -> None:
    """Sum products of the Gaussian, its slopes and the rest [B,3,D] over some views: sums [4,7].

    Rows and the first columns: as in `_set_columns`; the last three columns: the rest in RGB. Products are of what lies
    beyond the harmonics.
    """
    views, weights = around
    sets, directions, harmonics = sample
    sums[:] = 0.0
    for v in range(views.shape[0]):
        view, weight = views[v], weights[v]
        if weight == 0.0:
            continue
        basis = harmonics[sets[view]]
        _set_columns(axis, sharpness, frame, directions[sets[view]], columns)
        for i in range(4):
            for j in range(i + 1):
                sums[i, j] += weight * _product(columns[i], columns[j])
            for c in range(3):
                sums[i, 4 + c] += weight * _product(columns[i], rest[view, c])
        for k in range(basis.shape[0]):
            parts = (
                _product(columns[0], basis[k]),
                _product(columns[1], basis[k]),
                _product(columns[2], basis[k]),
                _product(columns[3], basis[k]),
            )
            for i in range(4):
                for j in range(i + 1):
                    sums[i, j] -= weight * parts[i] * parts[j]
    for i in range(4):
        for j in range(i):
            sums[j, i] = sums[i, j]


@compiled()
def _gain(sums: Any) -> Any:
    """What the best amplitudes of the Gaussian take from the squared rest."""
    return (sums[0, 4] ** 2 + sums[0, 5] ** 2 + sums[0, 6] ** 2) / sums[0, 0] if sums[0, 0] > 1e-30 else 0.0


@compiled()
def _step(sums: Any, damping: Any, step: Any) -> None:
    """Set the step [3] of Gauss and Newton for the axis and the sharpness, the amplitudes being the best ones."""
    matrix, slope = np.zeros((3, 3)), np.zeros(3)
    square = 0.0
    for c in range(3):
        square += (sums[0, 4 + c] / sums[0, 0]) ** 2
    for i in range(3):
        share = sums[1 + i, 0] / sums[0, 0]
        for c in range(3):
            slope[i] += sums[0, 4 + c] / sums[0, 0] * (sums[1 + i, 4 + c] - share * sums[0, 4 + c])
        for j in range(3):
            matrix[i, j] = square * (sums[1 + i, 1 + j] - share * sums[1 + j, 0])
    size = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    for i in range(3):
        matrix[i, i] += damping * matrix[i, i] + 1e-6 * size + 1e-300
    step[:] = np.linalg.solve(matrix, slope)
    for i in range(2):
        step[i] = min(max(step[i], -_LONGEST_TURN), _LONGEST_TURN)
    step[2] = min(max(step[2], -_LONGEST_STRETCH), _LONGEST_STRETCH)


@compiled()
def _across(axis: Any, frame: Any) -> None:
    """Set two unit vectors [2,3] across an axis."""
    x, y, z = axis
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    frame[0, 0], frame[0, 1], frame[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    frame[1, 0], frame[1, 1], frame[1, 2] = b, sign + y * y * a, -y


@compiled(nogil=True)
def refine(
    axes: Any,
    sharpness: Any,
    powers: Any,
    views: Any,
    weights: Any,
    sample: Any,
    limits: Any,
    rest: Any,
) -> None:
    """Improve the lobes of all nodes by themselves, and set their powers.

    axes [n,N,3], sharpness [n,N], powers [n,N,3]; views, weights [N,q]: the views around each node; sample: sets [B],
    their directions [P,3,D] and harmonics [P,K,D], orthonormal rows; limits: of the sharpness; rest [n,B,3,D].
    """
    for vertex in range(rest.shape[0]):
        sums, tried = np.zeros((4, 7)), np.zeros((4, 7))
        columns = np.zeros((4, rest.shape[3]))
        frame, axis, turned, step = np.zeros((2, 3)), np.zeros(3), np.zeros(3), np.zeros(3)
        for node in range(axes.shape[1]):
            axis[:] = axes[vertex, node]
            width = sharpness[vertex, node]
            around = views[node], weights[node]
            _across(axis, frame)
            _gaussian_sums(axis, width, frame, around, sample, rest[vertex], sums, columns)
            damping, gain = 1e-2, _gain(sums)
            for _ in range(_STEPS):
                if gain <= 0.0:
                    break
                _step(sums, damping, step)
                for c in range(3):
                    turned[c] = axis[c] + step[0] * frame[0, c] + step[1] * frame[1, c]
                turned /= math.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2)
                other = min(max(width * math.exp(step[2]), limits[0]), limits[1])
                _across(turned, frame)
                _gaussian_sums(turned, other, frame, around, sample, rest[vertex], tried, columns)
                if _gain(tried) > gain:
                    axis[:], width, gain = turned, other, _gain(tried)
                    sums[:] = tried
                    damping *= 0.3
                else:
                    _across(axis, frame)
                    damping *= 5.0
            axes[vertex, node] = axis
            sharpness[vertex, node] = width
            for c in range(3):
                powers[vertex, node, c] = power_of(sums[0, 4 + c] / sums[0, 0], width) if gain > 0.0 else 0.0


@compiled(nogil=True)
def subtract(
    axes: Any,
    sharpness: Any,
    powers: Any,
    nodes: Any,
    shares: Any,
    sample: Any,
    times: Any,
    rest: Any,
) -> None:
    """Subtract from the rest [n,B,3,D] what the lobes between the nodes add beyond the harmonics.

    nodes, shares [B,M]: the nodes around each view, and their weights; sample: as in `refine`.
    """
    sets, directions, harmonics = sample
    for vertex in range(rest.shape[0]):
        axis, power, shape = np.zeros(3), np.zeros(3), np.zeros(directions.shape[2])
        for view in range(rest.shape[1]):
            width = blend(shares[view], nodes[view], axes[vertex], sharpness[vertex], powers[vertex], axis, power)
            if width == 0.0:
                continue
            towards, basis = directions[sets[view]], harmonics[sets[view]]
            for d in range(len(shape)):
                cosine = towards[0, d] * axis[0] + towards[1, d] * axis[1] + towards[2, d] * axis[2]
                shape[d] = _exp_of_negative(width * (cosine - 1.0))
            # The rows are orthonormal, so one may be subtracted after the other.
            for k in range(len(basis)):
                part = _product(shape, basis[k])
                for d in range(len(shape)):
                    shape[d] -= part * basis[k, d]
            for c in range(3):
                amplitude = times * amplitude_of(power[c], width)
                for d in range(len(shape)):
                    rest[vertex, view, c, d] -= amplitude * shape[d]
