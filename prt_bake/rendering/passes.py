"""One pass of a picture: every pixel seen through a few points of it, and what leaves the object there.

A pass is named by a seed of its own, a pixel's numbers by the pixel's place: what a pass sees does not depend on which
rows are traced together, on threads, or on what was traced before.
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
from prt_bake.rendering.surface_reflection import SurfaceReflection

Array = NDArray[np.float64]

PIXEL_STREAM = 0x9C
_RAYS_AT_ONCE = 1 << 17
_GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])
_MIDDLE_AND_CORNERS = np.array([[0.5, 0.5], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


class ObjectTracer(Protocol):
    """Something that tells what leaves an object towards the eye.

    points: of a pixel in a pass. samples: of the light, a pixel and pass. cost: of a point, over that of one walk, by
    which rows are taken together.
    """

    points: int
    samples: int
    cost: int

    def radiance(
        self, faces: NDArray[np.int64], barycentric: Array, outgoing: Array, keys: NDArray[np.uint64], seed: int
    ) -> tuple[Array, int]:
        """Radiance [N,3] that leaves faces [N] at (u, v) [N,2] along outgoing [N,3], and how many samples that took.

        keys [N] are pixel · points + point, and with the seed of the pass name all random numbers.
        """


@dataclass(frozen=True)
class PixelPoints:
    """Points of N pixels: rays [N·points,3] from the eye, what they meet first, and the keys [N·points] of the points.

    met: which of them show the object.
    """

    rays: Array
    hits: Hits
    keys: NDArray[np.uint64]
    met: NDArray[np.int64]
    points: int

    def on_object(self) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.uint64]]:
        """Faces, (u, v), directions to the eye and keys of the points that show the object."""
        return self.hits.faces[self.met], self.hits.barycentric[self.met], -self.rays[self.met], self.keys[self.met]

    def pixel_means(self, radiance: Array) -> Array:
        """Means over points [...,N,3] of radiance [...,M,3] of those on the object; the others are black."""
        seen = np.zeros((*radiance.shape[:-2], len(self.rays), 3))
        seen[..., self.met, :] = radiance
        return np.asarray(seen.reshape(*radiance.shape[:-2], -1, self.points, 3).mean(axis=-2))


class PassTracer:
    """An object under a lighting as a camera sees it, ready to be traced pass by pass."""

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
        """Build the camera's tree, unless it is given; blocks of rows are shared out to `workers` threads.

        `reflection` is added to what the object's `tracer` tells.
        """
        self._lighting, self._camera, self._background = lighting, camera, background
        self._tracer, self._workers = tracer, workers
        self._visibility = visibility or Visibility(mesh)
        self._reflection = reflection

    @property
    def samples(self) -> int:
        """Of the light, a pixel and pass, as the tracer draws them now."""
        return self._tracer.samples

    def trace(self, seed: int, follow: Callable[[float], None]) -> Iterator[tuple[slice, Array, Array, int]]:
        """Rows of a pass, one batch after another: (rows, radiance [R,W,3], coverage [R,W], samples).

        `follow` is told the share of the pass that is done.
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

    def covered(self) -> NDArray[np.int64]:
        """The pixels that show the object in their middle and corners, or in their middle where there are none."""
        pixels = np.arange(self._camera.width * self._camera.height)
        rays = pixel_rays(self._camera, pixels, np.broadcast_to(_MIDDLE_AND_CORNERS, (len(pixels), 5, 2)))
        met = self._visibility.first_hits(*rays.rows()).faces.reshape(-1, 5) >= 0
        whole = met.all(axis=1)
        return np.flatnonzero(whole if whole.any() else met[:, 0])

    def points(self, pixels: NDArray[np.int64], seed: int) -> PixelPoints:
        """The points of `pixels` [N] in the pass of this seed."""
        points = self._tracer.points
        origins, rays = pixel_rays(self._camera, pixels, _offsets(pixels, points, seed)).rows()
        keys = (pixels[:, None] * points + np.arange(points)).ravel().astype(np.uint64)
        hits = self._visibility.first_hits(origins, rays)
        return PixelPoints(rays, hits, keys, np.flatnonzero(hits.faces >= 0), points)

    def _trace_rows(self, rows: slice, seed: int) -> tuple[Array, Array, int]:
        width = self._camera.width
        points = self.points(np.arange(rows.start * width, rows.stop * width), seed)
        radiance, samples = self._tracer.radiance(*points.on_object(), seed)
        if self._reflection is not None:
            radiance = radiance + self._reflection.radiance(*points.on_object(), seed)
        seen = points.pixel_means(radiance)
        missed = np.flatnonzero(points.hits.faces < 0)
        if self._background and len(missed):
            behind = np.zeros(points.rays.shape)
            behind[missed] = self._lighting.radiance(points.rays[missed])
            seen += behind.reshape(-1, points.points, 3).mean(axis=1)
        coverage = (points.hits.faces >= 0).reshape(-1, width, points.points).mean(axis=2)
        return seen.reshape(-1, width, 3), coverage, samples


def some_of(pixels: NDArray[np.int64], count: int, seed: int) -> NDArray[np.int64]:
    """At most `count` of `pixels`, drawn at random, in order."""
    order = np.argsort(hashed(PIXEL_STREAM, seed, pixels), kind="stable")
    return np.sort(pixels[order[:count]])


def pass_seed(seed: int, number: int) -> int:
    """The seed of one pass of a picture."""
    return int(hashed(PIXEL_STREAM, seed, number) >> np.uint64(1))


def _offsets(pixels: NDArray[np.int64], points: int, seed: int) -> Array:
    """Points of each pixel [N,S,2]: a rank-1 lattice of golden ratios (Roberts 2018), shifted at random."""
    shift = uniforms((PIXEL_STREAM, seed, pixels), 2)
    return np.asarray((shift[:, None, :] + np.arange(points)[:, None] * _GOLDEN) % 1.0)
