"""One picture by every basis: the mean FLIP over the object's pixels, beside the picture of Ŝ itself."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.bases.points import Points, points_on
from prt_bake.bases.rows import Basis, Estimate, Values, radiance
from prt_bake.comparison.flip import hdr_flip_map, paper_exposures
from prt_bake.geometry.camera import Camera, Visibility
from prt_bake.shading.visible_points import PixelMeans, find_visible_points, grid_offsets

Array = NDArray[np.float64]


class Picture(NamedTuple):
    """The visible points of a picture, Ŝ there, and the light [T,M,3] in several rotations."""

    points: Points
    pixels: PixelMeans
    values: Values
    skies: Array


def visible(mesh: Mesh, camera: Camera) -> tuple[Points, PixelMeans]:
    """The points that a camera sees, one for each pixel."""
    found = find_visible_points(Visibility(mesh), camera, grid_offsets(1))
    return points_on(mesh, found.faces, found.barycentric, found.outgoing), PixelMeans(found.pixels, camera, 1)


def flip(basis: Basis, picture: Picture, light: int) -> Estimate:
    """The mean HDR-FLIP of a basis over the object and the rotations of a light; the least and the most of them."""
    approximated = basis.under[light](picture.values)
    mask = picture.pixels.means(None) > 0.0
    shaded, right = (radiance(part, picture.skies) for part in (approximated, picture.values.fitted))
    found = []
    for turn in range(len(picture.skies)):
        ours, exact = (picture.pixels.means(part[:, turn]) for part in (shaded, right))
        found.append(float(hdr_flip_map(ours, exact, paper_exposures(exact))[mask].mean()))
    return Estimate(float(np.mean(found)), min(found), max(found))
