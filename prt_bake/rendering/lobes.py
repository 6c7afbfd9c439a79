"""Lobes for the points of a picture: the importance module is evaluated once for each pixel.

Within a pixel the lobe hardly changes, and evaluating it costs as much as three evaluations of the network. Sampling is
unbiased with any lobe whose density is known. Pixels whose middle misses the object get a lobe for each point.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.camera import Camera, Visibility, pixel_rays
from prt_bake.mathematics.lobe import Lobe

Array = NDArray[np.float64]

_PIXELS_AT_ONCE = 1 << 16


class LobeModule(Protocol):
    """An importance module."""

    def lobe(self, positions: Array, outgoing: Array, normals: Array) -> Lobe:
        """Lobes of N points [N,3] seen along outgoing [N,3], with normals [N,3]."""


class PixelLobes:
    """The lobe at the middle of every pixel that shows the object there."""

    def __init__(self, module: LobeModule, mesh: Mesh, camera: Camera, visibility: Visibility | None = None) -> None:
        """Evaluate `module` for all pixels."""
        self._module = module
        visibility = visibility or Visibility(mesh)
        pixels = camera.width * camera.height
        self._row = np.full(pixels, -1, np.int64)
        parts: list[Lobe] = []
        known = 0
        for first in range(0, pixels, _PIXELS_AT_ONCE):
            numbers = np.arange(first, min(first + _PIXELS_AT_ONCE, pixels))
            origins, rays = pixel_rays(camera, numbers, np.full((len(numbers), 1, 2), 0.5)).rows()
            hits = visibility.first_hits(origins, rays)
            met = np.flatnonzero(hits.faces >= 0)
            if not len(met):
                continue
            corners = mesh.positions[mesh.faces[hits.faces[met]]]
            u, v = hits.barycentric[met, :1], hits.barycentric[met, 1:]
            positions = (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
            parts.append(module.lobe(positions, -rays[met], mesh.face_normals[hits.faces[met]]))
            self._row[numbers[met]] = known + np.arange(len(met))
            known += len(met)
        self._lobes = _concatenate(parts) if parts else None

    def at(self, pixels: NDArray[np.int64], positions: Array, outgoing: Array, normals: Array) -> Lobe:
        """Lobes of N points, as `PointLobes.at`."""
        rows = self._row[pixels]
        known, others = np.flatnonzero(rows >= 0), np.flatnonzero(rows < 0)
        parts = [] if self._lobes is None or not len(known) else [_subset(self._lobes, rows[known])]
        if len(others) or not parts:
            parts.append(self._module.lobe(positions[others], outgoing[others], normals[others]))
        if len(parts) == 1:
            return parts[0]
        return _subset(_concatenate(parts), np.argsort(np.concatenate([known, others])))


def _subset(lobe: Lobe, rows: NDArray[np.int64]) -> Lobe:
    return Lobe(lobe.axes[rows], lobe.sigma[rows], lobe.weights[rows], lobe.shape, lobe.share)


def _concatenate(lobes: list[Lobe]) -> Lobe:
    axes, sigma, weights = (
        np.concatenate([getattr(lobe, name) for lobe in lobes]) for name in ("axes", "sigma", "weights")
    )
    return Lobe(axes, sigma, weights, lobes[0].shape, lobes[0].share)
