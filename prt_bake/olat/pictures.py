"""The pictures of a test set: cameras, directional lights, held-out skies, and the coordinates of its files.

Cameras stand on a sphere about the object and look at its centre. Their directions, and those of the lights, are the
first points of scrambled Sobol sequences: those of the training set come first, those of the test set follow. So no
direction is in both sets, and each set covers the sphere evenly.

The files have coordinates of their own, because their readers expect an object of unit size at the origin with z up:
the longest side of the object's bounding box is 1, its centre is the origin.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import LightError, QueryError
from formats.mesh import Mesh
from formats.scene import Scene
from formats.scene.lights import DirectionalLight
from prt_bake.geometry.camera import Camera
from prt_bake.lights.environment import FROM_POLAR, project, rotation
from prt_bake.lights.lighting import Lighting, Sky, read_lighting
from prt_bake.mathematics.directions import sobol
from prt_bake.mathematics.random import hashed
from prt_bake.olat.settings import IRRADIANCE, OlatSettings

Array = NDArray[np.float64]

TRAIN, TEST, SKIES = "train", "test", "held_out_skies"
SETS = (TRAIN, TEST, SKIES)
_CAMERA_STREAM, _LIGHT_STREAM, _PATH_STREAM = 0xA1, 0xA2, 0xA3
_MARGIN = 1.08
_UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Picture:
    """One picture: its file name without suffix, relative to the folder, its camera and light, and its seed.

    direction: unit vector [3] to the light in scene coordinates; None under a sky. sky: the file name of the sky,
    relative to the folder; None under a directional light.
    """

    name: str
    camera: Camera
    lighting: Lighting
    seed: int
    direction: Array | None = None
    sky: str | None = None

    @property
    def set(self) -> str:
        """One of `SETS`."""
        return self.name.split("/", maxsplit=1)[0]


@dataclass(frozen=True)
class Coordinates:
    """From scene units to the coordinates of the files: `scale * turn @ (position - centre)`."""

    centre: Array
    turn: Array
    scale: float

    @classmethod
    def of(cls, mesh: Mesh, up: str) -> "Coordinates":
        """Unit size about the origin, z up."""
        to_z_up = FROM_POLAR["z"] @ FROM_POLAR[up].T
        low, high = mesh.bounds
        return cls(mesh.center, to_z_up, 1.0 / float((high - low).max()))

    def points(self, positions: Array) -> Array:
        """Positions [...,3] in the coordinates of the files."""
        return np.asarray(self.scale * (positions - self.centre) @ self.turn.T)

    def directions(self, towards: Array) -> Array:
        """Directions [...,3] in the coordinates of the files."""
        return np.asarray(towards @ self.turn.T)

    def camera_to_world(self, camera: Camera) -> Array:
        """The matrix [4,4] of a camera, as in OpenGL and Blender: x to the right, y upwards, z backwards."""
        right, above, forward = self.directions(camera.axes)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([right, above, -forward], axis=1)
        matrix[:3, 3] = self.points(camera.eye)
        return matrix

    def as_json(self) -> dict[str, Any]:
        """The matrix [4,4] from scene coordinates."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.turn
        matrix[:3, 3] = self.points(np.zeros(3))
        return {"scene_to_dataset": matrix.tolist(), "up": "z", "scale": self.scale}


def held_out_skies(paths: list[Path], up: str) -> dict[str, Lighting]:
    """Skies by the names of their files, each scaled to a mean radiance of 1 over the sphere.

    Raises LightError for a black sky and QueryError for two of one name; raises as `read_lighting`.
    """
    found: dict[str, Lighting] = {}
    for path in paths:
        name = f"{SKIES}/{path.stem}.exr"
        if name in found:
            raise QueryError(f"{path}: expected skies with different names, found two of {path.stem}; rename one")
        lighting = read_lighting(path, up)
        if len(lighting.skies) != 1 or lighting.suns:
            raise LightError(f"{path}: expected a sky, a lat-long picture, found a lights file; give its picture")
        image = lighting.skies[0].image
        mean = float(project(image, 0, up)[0].mean() / math.sqrt(4.0 * math.pi))
        if not mean > 0.0:
            raise LightError(f"{path}: is black: it gives no light; choose another sky")
        found[name] = Lighting((Sky((image / mean).astype(np.float32), up, rotation(0.0, up)),))
    return found


def pictures(scene: Scene, settings: OlatSettings, skies: dict[str, Lighting]) -> Iterator[Picture]:
    """Yield the pictures of all sets in the order in which they are rendered."""
    cameras = _cameras(scene, settings)
    lights = _directions(settings.lights + settings.test_lights, settings.seed, _LIGHT_STREAM)
    views = {TRAIN: range(settings.views), TEST: range(settings.views, len(cameras))}
    lit_from = {TRAIN: range(settings.lights), TEST: range(settings.lights, len(lights))}
    for name in (TRAIN, TEST):
        for view in views[name]:
            for light in lit_from[name]:
                sun = DirectionalLight(lights[light], np.full(3, IRRADIANCE), settings.light_diameter)
                yield Picture(
                    f"{name}/v{view:03d}_l{light:03d}",
                    cameras[view],
                    Lighting((), (sun,)),
                    _seed(settings.seed, 0, view, light),
                    direction=sun.direction,
                )
    for view in views[TEST]:
        for number, (sky, lighting) in enumerate(skies.items()):
            name = f"{SKIES}/v{view:03d}_{Path(sky).stem}"
            yield Picture(name, cameras[view], lighting, _seed(settings.seed, 1, view, number), sky=sky)


def _cameras(scene: Scene, settings: OlatSettings) -> list[Camera]:
    """Cameras at one distance, at which the object's bounding ball fits."""
    mesh = scene.mesh
    half = math.radians(settings.fov) / 2.0
    narrow = min(half, math.atan(math.tan(half) * settings.width / settings.height))
    radius = float(np.linalg.norm(mesh.positions - mesh.center, axis=1).max())
    distance = _MARGIN * radius / math.sin(narrow)
    towards = _directions(settings.views + settings.test_views, settings.seed, _CAMERA_STREAM)
    eyes, up = mesh.center + distance * towards, np.array(_UP[scene.up])
    return [Camera(eye, mesh.center, up, settings.fov, settings.width, settings.height) for eye in eyes]


def _directions(count: int, seed: int, stream: int) -> Array:
    return sobol(count, _word(stream, seed))


def _seed(*keys: int) -> int:
    return _word(_PATH_STREAM, *keys)


def _word(*keys: int) -> int:
    return int(hashed(*keys) >> np.uint64(1))
