"""Signed distance grids of a scene's object and of what it contains, and its meshes, within the bytes of a model."""

import math
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from formats.scene import Medium, Part, Scene
from prt_bake.geometry.distances import grid_distances
from prt_bake.network.features.feature_grid import kept_places
from prt_bake.network.features.inner_bodies import InnerBody, Shape, fitting_bodies
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.view_features import interval_edges
from prt_bake.network.settings import NetworkSettings
from prt_bake.trainer.material import material_of
from prt_bake.trainer.samples.rows import Box

Array = NDArray[np.float64]

MOST_BYTES = 49_152
"""Byte budget of the grids in a model file; with weights and meshes a model stays below 1,416 KiB."""
MOST_LEARNED_BYTES = 245_760
"""Byte budget of the learned feature grid in a model file."""
MOST_BODIES = 4
"""The object and the largest parts inside it."""
_HALF_BYTES = 2
_MOST_POINTS = 96**3
_MOST_ACROSS = 320
_MARGIN = 1.02
_SURROUND = 2
"""Grid points added on each side of the box."""
_CLEAR = 4.0
"""Optical depth of the box side at which a fiftieth of the light is left."""
_OPAQUE = 1e3
"""Attenuation per box side of a part that no light enters."""


def interior_of(scene: Scene, box: Box, with_meshes: bool = False, with_material: bool = False) -> Interior:
    """The interior of a scene: the finest grids, of at most 96³ points per body, that fit into MOST_BYTES.

    with_meshes: also the meshes of the bodies inside, through which view rays can be followed. with_material: also what
    varies of the material.
    """
    bodies = _bodies(scene.parts)
    meshes = [
        trimesh.Trimesh((part.mesh.positions - box.corner) / box.side, part.mesh.faces, process=True) for part in bodies
    ]
    attenuation = tuple(_attenuation(part, box.side) for part in bodies)
    inner = _inner(bodies, meshes, scene) if with_meshes else ()
    low, high = np.asarray(meshes[0].bounds, np.float64)
    spacing = _spacing(high - low)
    while True:
        shape = _grid_shape(high - low, spacing)
        corner = 0.5 * (low + high) - 0.5 * (shape - 1) * spacing
        levels = np.stack([_levels(mesh, shape, corner, spacing) for mesh in meshes])
        origin = float(corner[0]), float(corner[1]), float(corner[2])
        interior = Interior(levels, origin, spacing, attenuation, float(scene.eta), inner)
        size = len(interior.packed())
        if size <= MOST_BYTES:
            break
        # The packed size is that of the surface, which grows fourfold at half the spacing.
        spacing *= _MARGIN * math.sqrt(size / MOST_BYTES)
    if not with_material:
        return interior
    reach = float(interval_edges(interior, with_meshes)[-1])
    return replace(interior, material=material_of(bodies, box, interior, reach))


def with_fitting_grid(settings: NetworkSettings, interior: Interior) -> NetworkSettings:
    """The settings with `grid_places` lowered until the learned grid fits into MOST_LEARNED_BYTES."""
    reach = float(interval_edges(interior, settings.interfaces > 0)[-1])
    places = settings.grid_places
    while places > 1:
        rows = int(kept_places(interior, places, reach).sum())
        if rows * settings.grid_numbers * _HALF_BYTES <= MOST_LEARNED_BYTES:
            break
        places -= 1
    return replace(settings, grid_places=places)


def is_clear(scene: Scene, box: Box) -> bool:
    """Whether view rays often cross the object's outermost medium without being scattered."""
    return _attenuation(scene.parts[0], box.side) < _CLEAR


def _bodies(parts: tuple[Part, ...]) -> list[Part]:
    """The outermost part, then the largest parts inside by volume: each after those that contain it, siblings in the
    order of the file.
    """
    volumes = [abs(trimesh.Trimesh(part.mesh.positions, part.mesh.faces, process=False).volume) for part in parts]
    largest = sorted(range(1, len(parts)), key=lambda index: -volumes[index])[: MOST_BODIES - 1]
    order = sorted(largest, key=lambda index: (len(_around(parts, index)), index))
    return [parts[0], *(parts[index] for index in order)]


def _around(parts: tuple[Part, ...], index: int) -> list[int]:
    """The parts that contain a part, from the inside."""
    found = []
    while (index := parts[index].parent) >= 0:
        found.append(index)
    return found


def _inner(bodies: list[Part], meshes: list[trimesh.Trimesh], scene: Scene) -> tuple[InnerBody, ...]:
    """The meshes of the bodies after the first."""
    shapes, numbers = [], [scene.parts.index(part) for part in bodies]
    for part, mesh, number in zip(bodies[1:], meshes[1:], numbers[1:], strict=True):
        parent = next(index for index in _around(scene.parts, number) if index in numbers)
        positions = np.asarray(mesh.vertices, np.float64)
        shapes.append(Shape(positions, mesh.faces, numbers.index(parent), float(part.eta), part.normals == "vertex"))
    return fitting_bodies(shapes)


def _attenuation(part: Part, side: float) -> float:
    """Mean σt (1 − albedo·max(g, 0)) per box side: light scattered forward is not lost to a view ray."""
    if part.medium is None:
        return _OPAQUE if part.diffuse is not None else 0.0
    medium: Medium = part.medium
    forward = float(np.mean(medium.albedo)) * max(medium.phase_g, 0.0)
    return float(np.mean(medium.sigma_t)) * (1.0 - forward) * side


def _spacing(extent: Array) -> float:
    """The finest spacing at which the box has at most _MOST_POINTS grid points, by bisection."""
    low, high = 1.0 / _MOST_ACROSS, 1.0
    for _ in range(40):
        middle = math.sqrt(low * high)
        if np.prod(_grid_shape(extent, middle), dtype=np.float64) > _MOST_POINTS:
            low = middle
        else:
            high = middle
    return high


def _grid_shape(extent: Array, spacing: float) -> NDArray[np.int64]:
    return np.asarray(np.ceil(extent / spacing) + 1 + 2 * _SURROUND, np.int64)


def _levels(mesh: trimesh.Trimesh, shape: NDArray[np.int64], corner: Array, spacing: float) -> NDArray[np.int8]:
    """Quantised signed distances [X,Y,Z] of one body, positive inside."""
    reach = REACH * spacing
    distances = grid_distances(np.asarray(mesh.triangles, np.float64), shape, corner, spacing, reach)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    inside = mesh.contains(corner + spacing * grid).reshape(distances.shape)
    return np.asarray(np.rint(np.where(inside, distances, -distances) * (LEVELS / reach)), np.int8)
