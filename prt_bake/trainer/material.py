"""The channels of a scene's material that vary over it, sampled for the network (`prt_bake.network.features.material`).

They are logarithms of the attenuation, the mean over the colours, and of the absorbed share of each colour, relative to
their means in the same body, and the roughness of the outermost interface. In an opaque body the absorbed share is that
of its surface.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from formats.mesh import Mesh
from formats.scene import Medium, Part
from prt_bake.network.features.feature_grid import kept_places
from prt_bake.network.features.interior import Interior
from prt_bake.network.features.material import STEPS, Material
from prt_bake.reflection.finish import interface_alpha
from prt_bake.trainer.samples.rows import Box

Array = NDArray[np.float64]

MOST_BYTES, MOST_ROWS = 98_304, 1 << 17
"""Budgets of the material: bytes in a model file, and nodes, which take time when it is loaded."""
_FINEST = 96
"""Nodes per box side where they fit, and where the interior's grid is as fine."""
_COARSER = 0.85
_SURFACE_SAMPLES = 200_000
_NEAR = 0.1
"""Distance from a surface, in box sides, up to which its textures count."""
_LEAST_ATTENUATION, _LEAST_ABSORBED = 1e-2, 1e-3
"""Lower limits of the attenuation per box side and of the absorbed share, before their logarithms."""
_LEAST_RANGE = 0.02
"""Least difference between the highest and the lowest value of a channel, logarithms or GGX alpha."""


def material_of(bodies: list[Part], box: Box, interior: Interior, reach: float) -> Material | None:
    """The channels that vary at the nodes along view rays of length `reach`, on the finest grid within the budgets.

    bodies: those of the interior, in its order. None if nothing varies within any of them. Where one body ends and
    another begins is no part of it: view rays show that.
    """
    if not any(map(_varies, bodies)):
        return None
    per_side = min(_FINEST, int(1.0 / interior.spacing))
    while True:
        nodes = np.argwhere(kept_places(interior, per_side, reach))
        if len(nodes) <= MOST_ROWS:
            material = _sampled(bodies, box, interior, per_side, nodes)
            if material is None or len(material.packed()) <= MOST_BYTES:
                return material
        per_side = int(per_side * _COARSER)


def _sampled(
    bodies: list[Part], box: Box, interior: Interior, per_side: int, nodes: NDArray[np.int64]
) -> Material | None:
    """The channels that vary at nodes [K,3]; None if none does."""
    channels = _channels(bodies, box, interior, np.array(interior.corner) + nodes / per_side)
    low, high = channels.min(axis=0), channels.max(axis=0)
    varies = high - low > _LEAST_RANGE
    if not varies.any():
        return None
    steps = np.rint((channels - low)[:, varies] * (STEPS / (high - low)[varies]))
    return Material(per_side, steps.astype(np.uint8))


def _varies(part: Part) -> bool:
    """Whether a body has a grid or a texture."""
    quantities = [np.asarray(part.roughness)[..., None]]
    if part.diffuse is not None:
        quantities.append(part.diffuse)
    if part.medium is not None:
        quantities += [part.medium.sigma_t, part.medium.albedo]
    return any(quantity.ndim > 1 for quantity in quantities)


def _channels(bodies: list[Part], box: Box, interior: Interior, places: Array) -> Array:
    """All channels [K,5] at places [K,3] in box sides."""
    points = box.corner + box.side * places
    at = (places - interior.corner) / interior.spacing
    body = np.zeros(len(points), np.int64)
    for number, levels in enumerate(interior.levels[1:].astype(np.float64), start=1):
        body[ndimage.map_coordinates(levels, at.T, order=1, mode="nearest") > 0] = number
    found = np.empty((len(points), 4))
    for number in np.unique(body):
        own = body == number
        values = _substance(bodies[number], points[own], box.side)
        found[own] = values - values.mean(axis=0)
    rough = _on_surface(bodies[0].mesh, [np.asarray(bodies[0].roughness)], points, box.side)
    return np.concatenate([found, rough], axis=1)


def _substance(part: Part, points: Array, side: float) -> Array:
    """Logarithms of the attenuation per box side and of the absorbed shares [N,4] in a body."""
    if part.medium is None:
        attenuation = np.ones((len(points), 1))
        assert part.diffuse is not None
        albedo = _on_surface(part.mesh, [part.diffuse[..., colour] for colour in range(3)], points, side)
    else:
        attenuation = side * _in_medium(part.medium, part.medium.sigma_t, points).mean(axis=1, keepdims=True)
        albedo = np.broadcast_to(_in_medium(part.medium, part.medium.albedo, points), (len(points), 3))
    attenuation, absorbed = np.maximum(attenuation, _LEAST_ATTENUATION), np.maximum(1.0 - albedo, _LEAST_ABSORBED)
    return np.asarray(np.log(np.concatenate([attenuation, absorbed], axis=1)))


def _in_medium(medium: Medium, quantity: Array, points: Array) -> Array:
    """A quantity of the medium at points [N,3], [N,1] or [N,3]: trilinear between the centres of its cells."""
    if quantity.ndim < 3:
        return np.broadcast_to(quantity, (len(points), max(1, quantity.size)))
    assert medium.bounds is not None
    low, high = medium.bounds
    grid = quantity[..., None] if quantity.ndim == 3 else quantity
    at = ((points - low) / (high - low))[:, ::-1] * grid.shape[:3] - 0.5
    values = [ndimage.map_coordinates(part, at.T, order=1, mode="nearest") for part in np.moveaxis(grid, -1, 0)]
    return np.stack(values, axis=1)


def _on_surface(mesh: Mesh, textures: list[Array], points: Array, side: float) -> Array:
    """Textures, or constants, [N, textures] at the points of a mesh that are next to points [N,3].

    Points further than _NEAR from it have the mean.
    """
    if all(texture.ndim == 0 for texture in textures):
        return np.asarray(np.broadcast_to(np.array(textures, np.float64), (len(points), len(textures))))
    random, area = np.random.default_rng(0), np.asarray(mesh.face_areas, np.float64)
    faces = random.choice(len(area), _SURFACE_SAMPLES, p=area / area.sum())
    weights = random.dirichlet((1.0, 1.0, 1.0), _SURFACE_SAMPLES)
    samples = np.einsum("nk,nkc->nc", weights, mesh.positions[mesh.faces[faces]])
    values = np.stack([interface_alpha(mesh, faces, weights[:, 1:], texture) for texture in textures], axis=1)
    _distance, nearest = KDTree(samples).query(points, distance_upper_bound=_NEAR * side)
    return np.asarray(np.concatenate([values, values.mean(axis=0, keepdims=True)])[nearest])
