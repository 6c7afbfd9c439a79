"""The points of an object that a picture's samples see, and means over the samples of each pixel."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from prt_bake.geometry.camera import Camera, Visibility, rays

Array = NDArray[np.float64]

_RAYS_AT_ONCE = 1 << 15


class Seen(NamedTuple):
    """The samples of a picture that meet the object: their pixels [n], row · width + column, which sample of the pixel
    [n], faces [n], (u, v) [n,2], and unit directions to the eye [n,3].
    """

    pixels: NDArray[np.int64]
    samples: NDArray[np.int64]
    faces: NDArray[np.int64]
    barycentric: Array
    outgoing: Array


class PixelMeans:
    """Means over all `samples` of each pixel, of values at those that meet the object; `pixels` [n] are theirs."""

    def __init__(self, pixels: NDArray[np.int64], camera: Camera, samples: int) -> None:
        self._pixels, self._samples, self._shape = pixels, samples, (camera.height, camera.width)

    def means(self, values: Array | None) -> Array:
        """Over all samples of a pixel, [H,W,C] of values [n,C] of those on the object; [H,W] the object's share."""
        columns = (None,) if values is None else values.T
        count = math.prod(self._shape)
        sums = [np.bincount(self._pixels, column, count).reshape(self._shape) for column in columns]
        return np.asarray((sums[0] if values is None else np.stack(sums, axis=-1)) / self._samples)


def cast(visibility: Visibility, camera: Camera, offsets: Array) -> Seen:
    """The samples of a picture that meet the object, `offsets` [S,2] of each pixel; raises QueryError for none."""
    parts = []
    for rows in row_blocks(camera, len(offsets)):
        origins, directions = rays(camera, rows, offsets).rows()
        hits = visibility.first_hits(origins, directions)
        met = np.flatnonzero(hits.faces >= 0)
        pixels, sample = np.divmod(met, len(offsets))
        pixels += rows.start * camera.width
        parts.append(Seen(pixels, sample, hits.faces[met], hits.barycentric[met], -directions[met]))
    seen = Seen._make(np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(seen.pixels):
        raise QueryError(
            f"camera: the eye at {camera.eye.tolist()}, looking at {camera.target.tolist()}, sees nothing of the "
            "object; turn it to the object, or narrow the view of one far away"
        )
    return seen


def row_blocks(camera: Camera, samples: int) -> Iterator[slice]:
    """Rows of the picture, few enough for the arrays of one block to stay in cache."""
    step = max(1, _RAYS_AT_ONCE // (camera.width * samples))
    for first in range(0, camera.height, step):
        yield slice(first, min(first + step, camera.height))


def grid_offsets(samples: int) -> Array:
    """The centres of a samples × samples grid in the pixel [S,2]."""
    steps = (np.arange(samples) + 0.5) / samples
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
