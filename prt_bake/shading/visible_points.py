"""The points of an object that are visible in a picture, and means over the samples of each pixel."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from prt_bake.geometry.camera import Camera, Visibility, rays

Array = NDArray[np.float64]

_RAYS_AT_ONCE = 1 << 15


class VisiblePoints(NamedTuple):
    """Points of the object that are hit by the camera rays of a picture.

    pixels [n]: row · width + column. samples [n]: number of the sample within its pixel. faces [n]; (u, v) barycentric
    [n,2]; outgoing [n,3]: unit directions to the eye.
    """

    pixels: NDArray[np.int64]
    samples: NDArray[np.int64]
    faces: NDArray[np.int64]
    barycentric: Array
    outgoing: Array

    def subset(self, chosen: slice) -> "VisiblePoints":
        """The points of a slice."""
        return VisiblePoints._make(part[chosen] for part in self)


class PixelMeans:
    """Averages values at visible points over all `samples` of their `pixels` [n]."""

    def __init__(self, pixels: NDArray[np.int64], camera: Camera, samples: int) -> None:
        self._pixels, self._samples, self._shape = pixels, samples, (camera.height, camera.width)

    def means(self, values: Array | None) -> Array:
        """Pixels [H,W,C] from values [n,C] at the visible points; for None the coverage [H,W]."""
        columns = (None,) if values is None else values.T
        count = math.prod(self._shape)
        sums = [np.bincount(self._pixels, column, count).reshape(self._shape) for column in columns]
        return np.asarray((sums[0] if values is None else np.stack(sums, axis=-1)) / self._samples)


def find_visible_points(visibility: Visibility, camera: Camera, offsets: Array) -> VisiblePoints:
    """Trace the camera rays at `offsets` [S,2] of each pixel. Raises QueryError if no ray hits the object."""
    parts = []
    for rows in row_blocks(camera, len(offsets)):
        origins, directions = rays(camera, rows, offsets).rows()
        hits = visibility.first_hits(origins, directions)
        met = np.flatnonzero(hits.faces >= 0)
        pixels, sample = np.divmod(met, len(offsets))
        pixels += rows.start * camera.width
        parts.append(VisiblePoints(pixels, sample, hits.faces[met], hits.barycentric[met], -directions[met]))
    points = VisiblePoints._make(np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(points.pixels):
        raise QueryError(
            f"camera: the eye at {camera.eye.tolist()}, looking at {camera.target.tolist()}, sees nothing of the "
            "object; turn it to the object, or narrow its field of view if the object is far away"
        )
    return points


def row_blocks(camera: Camera, samples: int) -> Iterator[slice]:
    """Blocks of rows of the picture, small enough for their arrays to stay in cache."""
    step = max(1, _RAYS_AT_ONCE // (camera.width * samples))
    for first in range(0, camera.height, step):
        yield slice(first, min(first + step, camera.height))


def grid_offsets(samples: int) -> Array:
    """The centres of a samples × samples grid in the pixel [S,2]."""
    steps = (np.arange(samples) + 0.5) / samples
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
