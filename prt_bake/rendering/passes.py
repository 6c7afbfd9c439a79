"""One pass of a picture: a few rays through each pixel, and the radiance of the object where they hit it.

A pass has its own seed, and a pixel's random numbers depend on the pixel's index. The result therefore does not depend
on which rows are traced together, on threads, or on earlier passes.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.geometry.camera import Camera, Hits, Visibility, pixel_rays
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics.random import hashed, uniforms
from prt_bake.rendering.object_points import ObjectPoints
from prt_bake.rendering.surface_reflection import SurfaceReflection

Array = NDArray[np.float64]

PIXEL_STREAM = 0x9C
_PIXELS_AT_ONCE = 1 << 16
_RAYS_AT_ONCE = 1 << 17
_R2_SEQUENCE = np.array([0.7548776662466927, 0.5698402909980532])
_MIDDLE_AND_CORNERS = np.array([[0.5, 0.5], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


class ObjectTracer(Protocol):
    """Computes the radiance that leaves an object towards the eye.

    points: per pixel and pass. samples: of the light, per pixel and pass. cost: of a point over that of one walk, for
    choosing the number of rows in a batch.
    """

    points: int
    samples: int
    cost: int

    def radiance(self, points: ObjectPoints, seed: int) -> tuple[Array, int]:
        """Radiance [N,3] that leaves the points towards the eye in the pass of `seed`, and the number of samples."""


@dataclass(frozen=True)
class PixelPoints:
    """Points of N pixels: rays [N·points,3] from the eye, their first hits, and the keys [N·points].

    met: indices of the points on the object.
    """

    rays: Array
    hits: Hits
    keys: NDArray[np.uint64]
    met: NDArray[np.int64]
    points: int

    def on_object(self) -> ObjectPoints:
        """The points on the object."""
        return ObjectPoints(
            self.hits.faces[self.met], self.hits.barycentric[self.met], -self.rays[self.met], self.keys[self.met]
        )

    def pixel_means(self, radiance: Array) -> Array:
        """Pixels [...,N,3] from radiance [...,M,3] at the points on the object; the other points are black."""
        values = np.zeros((*radiance.shape[:-2], len(self.rays), 3))
        values[..., self.met, :] = radiance
        return np.asarray(values.reshape(*radiance.shape[:-2], -1, self.points, 3).mean(axis=-2))


class PassTracer:
    """Traces passes of an object under a lighting, seen by a camera."""

    def __init__(
        self,
        mesh: Mesh,
        lighting: Lighting,
        camera: Camera,
        background: bool,
        tracer: ObjectTracer,
        workers: int = 1,
        visibility: Visibility | None = None,
        reflection: SurfaceReflection | None = None,
    ) -> None:
        """Build the mesh's visibility unless given; `workers` threads trace blocks of rows.

        `reflection` is added to the radiance of `tracer`.
        """
        self._lighting, self._camera, self._background = lighting, camera, background
        self._tracer, self._workers = tracer, workers
        self._visibility = visibility or Visibility(mesh)
        self._reflection = reflection

    @property
    def samples(self) -> int:
        """Samples of the light per pixel and pass, for the tracer's current mixture."""
        return self._tracer.samples

    def trace(self, seed: int, follow: Callable[[float], None]) -> Iterator[tuple[slice, Array, Array, int]]:
        """Yield the rows of a pass in batches: (rows, radiance [R,W,3], coverage [R,W], samples).

        `follow` is called with the finished share of the pass.
        """
        height, width = self._camera.height, self._camera.width
        step = max(1, _RAYS_AT_ONCE // (width * self._tracer.points * self._tracer.cost))
        blocks = [slice(first, min(first + step, height)) for first in range(0, height, step)]
        if self._workers == 1:
            for rows in blocks:
                yield rows, *self._trace_rows(rows, seed)
                follow(rows.stop / height)
            return
        with ThreadPoolExecutor(self._workers) as threads:
            for rows, done in zip(blocks, threads.map(lambda rows: self._trace_rows(rows, seed), blocks), strict=True):
                yield rows, *done
                follow(rows.stop / height)

    def pixels_on_object(self) -> NDArray[np.int64]:
        """Pixels whose middle and corners show the object; if there are none, pixels whose middle does."""
        blocks = np.array_split(
            np.arange(count := self._camera.width * self._camera.height), -(-count // _PIXELS_AT_ONCE)
        )
        met = np.concatenate([self._meets(pixels) for pixels in blocks])
        covered = met.all(axis=1)
        return np.flatnonzero(covered if covered.any() else met[:, 0])

    def _meets(self, pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the middle and the corners of pixels [N] show the object [N,5]."""
        rays = pixel_rays(self._camera, pixels, np.broadcast_to(_MIDDLE_AND_CORNERS, (len(pixels), 5, 2)))
        return self._visibility.first_hits(*rays.rows()).faces.reshape(-1, 5) >= 0

    def points(self, pixels: NDArray[np.int64], seed: int) -> PixelPoints:
        """The points of `pixels` [N] in the pass of `seed`."""
        points = self._tracer.points
        origins, rays = pixel_rays(self._camera, pixels, _offsets(pixels, points, seed)).rows()
        keys = (pixels[:, None] * points + np.arange(points)).ravel().astype(np.uint64)
        hits = self._visibility.first_hits(origins, rays)
        return PixelPoints(rays, hits, keys, np.flatnonzero(hits.faces >= 0), points)

    def _trace_rows(self, rows: slice, seed: int) -> tuple[Array, Array, int]:
        width = self._camera.width
        points = self.points(np.arange(rows.start * width, rows.stop * width), seed)
        radiance, samples = self._tracer.radiance(points.on_object(), seed)
        if self._reflection is not None:
            radiance = radiance + self._reflection.radiance(points.on_object(), seed)
        means = points.pixel_means(radiance)
        missed = np.flatnonzero(points.hits.faces < 0)
        if self._background and len(missed):
            behind = np.zeros(points.rays.shape)
            behind[missed] = self._lighting.radiance(points.rays[missed])
            means += behind.reshape(-1, points.points, 3).mean(axis=1)
        coverage = (points.hits.faces >= 0).reshape(-1, width, points.points).mean(axis=2)
        return means.reshape(-1, width, 3), coverage, samples


def random_subset(pixels: NDArray[np.int64], count: int, seed: int) -> NDArray[np.int64]:
    """At most `count` random elements of `pixels`, in order."""
    order = np.argsort(hashed(PIXEL_STREAM, seed, pixels), kind="stable")
    return np.sort(pixels[order[:count]])


def pass_seed(seed: int, number: int) -> int:
    """The seed of one pass of a picture."""
    return int(hashed(PIXEL_STREAM, seed, number) >> np.uint64(1))


def _offsets(pixels: NDArray[np.int64], points: int, seed: int) -> Array:
    """Points of each pixel [N,S,2]: the R2 sequence (Roberts 2018) with a random shift."""
    shift = uniforms((PIXEL_STREAM, seed, pixels), 2)
    return np.asarray((shift[:, None, :] + np.arange(points)[:, None] * _R2_SEQUENCE) % 1.0)
