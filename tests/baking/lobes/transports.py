"""Transports with lobes on a ball, and the error of their assets."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import prt_bake as prt
from formats.asset import Asset
from formats.scene.lights import DirectionalLight
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.directions import fibonacci
from tests.shapes import ball

Array = NDArray[np.float64]
Axes = Callable[[Array, Array], Array]
"""Unit normals [N,3] and unit views [N,3] → unit axes [N,3]."""

MESH = ball(1)
COLOUR = np.array([1.0, 0.5, 0.2])


def mirrored(normals: Array, outgoing: Array) -> Array:
    """The reflection of the view in the normal."""
    return np.asarray(2.0 * (outgoing * normals).sum(axis=1, keepdims=True) * normals - outgoing)


def along_normal(normals: Array, outgoing: Array) -> Array:
    """The normal, in all views."""
    return normals


def bent(normals: Array, outgoing: Array) -> Array:
    """A direction between the normal and the mirrored view, which depends little on the view."""
    axis = 2.0 * normals + mirrored(normals, outgoing)
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))


@dataclass
class Lobed:
    """A constant and lobes on a ball, each with its own axes, sharpness and size."""

    lobes: tuple[tuple[Axes, float, float], ...] = ((bent, 12.0, 1.0),)
    constant: float = 0.1

    def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> Array:
        """Ŝ [N,D,3]."""
        towards = np.broadcast_to(np.asarray(incident), (len(positions), *np.shape(incident)[-2:]))
        normals = np.asarray(positions) / np.linalg.norm(positions, axis=1, keepdims=True)
        value = np.full(towards.shape[:2], self.constant)
        for axes, sharpness, size in self.lobes:
            cosine = np.einsum("ndi,ni->nd", towards, axes(normals, np.asarray(outgoing)))
            value += size * np.exp(sharpness * (cosine - 1.0))
        return np.asarray(value[..., None] * COLOUR)


class LowAlone(Lobed):
    """The same, which has nothing but a constant in its coefficients."""

    def up_to(self, degree: int) -> Lobed:
        """For coefficients."""
        return Lobed((), self.constant)


class Smooth:
    """Ŝ of degree 1."""

    def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> Array:
        """Ŝ [N,D,3]."""
        towards = np.broadcast_to(np.asarray(incident), (len(positions), *np.shape(incident)[-2:]))
        return np.repeat(1.0 + towards[..., :1], 3, axis=-1)


def errors(transport: Any, asset: Asset, outgoing: Array, count: int = 24) -> tuple[float, float]:
    """Relative RMSE under `count` suns from all directions, without and with lobes. outgoing [V,3]: to the eye."""
    suns, found = fibonacci(count), []
    exact = transport.evaluate(suns, MESH.positions, outgoing)
    for shown in (replace(asset, lobes=None), asset):
        shaded = np.empty_like(exact)
        for number, sun in enumerate(suns):
            light = Lighting((), (DirectionalLight(sun, np.ones(3), 0.0),))
            lit = prt.light_for(shown, light, "plain" if shown.lobes is None else "split")
            shaded[:, number] = prt.shade(shown, lit, outgoing)
        found.append(float(np.linalg.norm(shaded - exact) / np.linalg.norm(exact)))
    return found[0], found[1]


def towards(sine: float) -> Array:
    """Views [V,3] at this sine to the normals."""
    across_normals = np.cross(MESH.normals, [0.3, 0.5, 0.8])
    across_normals /= np.linalg.norm(across_normals, axis=1, keepdims=True)
    return np.asarray(np.sqrt(1.0 - sine**2) * MESH.normals + sine * across_normals)
