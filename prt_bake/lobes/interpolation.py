"""Lobes between the nodes: those of vertices in given views."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.asset.lobes import Lobes
from prt_bake.jit.compilation import compiled
from prt_bake.mathematics.sphere import bin_weights

Array = NDArray[np.float64]


class LobesAtViews(NamedTuple):
    """J lobes of n views: unit axes [n,J,3], sharpness [n,J], 0 without a lobe, and powers [n,J,3]."""

    axes: Array
    sharpness: Array
    powers: Array


def lobes_at(lobes: Lobes, vertices: NDArray[np.int64], local: Array) -> LobesAtViews:
    """The lobes of `vertices` [n] seen along `local` [n,3] in their frames."""
    nodes, weights = bin_weights(local, lobes.rings, lobes.sectors)
    shape = len(vertices), lobes.count
    found = LobesAtViews(np.zeros((*shape, 3)), np.zeros(shape), np.zeros((*shape, 3)))
    _blend_all(lobes.axes, lobes.sharpness, lobes.powers, vertices, nodes, weights, *found)
    return found


@compiled()
def power_of(amplitude: Any, sharpness: Any) -> Any:
    """The integral over the sphere of a Gaussian with this value along its axis."""
    return amplitude * 2.0 * math.pi * -math.expm1(-2.0 * sharpness) / sharpness


@compiled()
def amplitude_of(power: Any, sharpness: Any) -> Any:
    """The value of a Gaussian along its axis, from its integral over the sphere."""
    return power * sharpness / (2.0 * math.pi * -math.expm1(-2.0 * sharpness))


@compiled()
def blend(weights: Any, nodes: Any, axes: Any, sharpness: Any, powers: Any, axis: Any, power: Any) -> Any:
    """Set the axis [3] and the power [3] of the lobe between `nodes`, and return its sharpness; 0 without a lobe."""
    axis[:] = 0.0
    power[:] = 0.0
    total = stretch = 0.0
    for m in range(nodes.shape[0]):
        node = nodes[m]
        strength = 0.0
        for c in range(3):
            power[c] += weights[m] * powers[node, c]
            strength += abs(powers[node, c])
        strength *= weights[m]
        total += strength
        stretch += strength * math.log(sharpness[node])
        for c in range(3):
            axis[c] += strength * axes[node, c]
    length = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    if total <= 0.0 or length <= 0.0:
        return 0.0
    axis /= length
    return math.exp(stretch / total)


@compiled(nogil=True)
def _blend_all(
    axes: Any, sharpness: Any, powers: Any, vertices: Any, nodes: Any, weights: Any, to_axes: Any, to_sharpness: Any,
    to_powers: Any,
) -> None:  # fmt: skip
    for n in range(len(vertices)):
        v = vertices[n]
        for j in range(to_sharpness.shape[1]):
            to_sharpness[n, j] = blend(
                weights[n], nodes[n], axes[v, :, j], sharpness[v, :, j], powers[v, :, j], to_axes[n, j], to_powers[n, j]
            )
