"""What lights a picture: skies and directional lights, their radiance in a direction, and all of it in one hash.

A directional light of irradiance E (across its direction) and angular diameter a has the radiance E / Ω over its disc,
Ω = 2π (1 − cos a/2), edges exact. One without size has no radiance anywhere: it can only be connected to.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import LightError, QueryError, refuse_path
from formats.image import READABLE
from formats.mesh import Mesh
from formats.scene.file import errors_at
from formats.scene.lights import (
    SPHERE_SYNTAX,
    SUN_SYNTAX,
    DirectionalLight,
    SkyLight,
    SphereLight,
    parse_sphere,
    parse_sun,
    read_lights,
)
from prt_bake.lights import environment
from prt_bake.lights.downsampled import shrink
from prt_bake.lights.sphere_lights import as_disc

Array = NDArray[np.float64]

_TO_MEND = "repair the picture, or have it mended (--mend; mend=True in Python)"
WHOLE_BYTES = 512 << 20
"""A sky up to this is read whole: a copy would take longer to make than it saves."""


@dataclass(frozen=True, eq=False)
class Sky:
    """A lat-long picture [H,W,3] of radiance with its up axis; `turn` [3,3] takes its directions to object space.

    residual: harmonics [K,3] of the picture's own directions, those of a larger picture less those of `image`, where
    `image` is a smaller copy of one; None where it is the whole.
    """

    image: NDArray[np.float32]
    up: str
    turn: Array
    residual: Array | None = None

    def radiance(self, directions: Array) -> Array:
        """Radiance [N,3] from `directions` [N,3]."""
        return environment.lookup(self.image, directions @ self.turn, self.up)


@dataclass(frozen=True, eq=False)
class Lighting:
    """Skies and directional lights together; raises QueryError where there is none of either."""

    skies: tuple[Sky, ...] = ()
    suns: tuple[DirectionalLight, ...] = ()

    def __post_init__(self) -> None:
        if not self.skies and not self.suns:
            raise QueryError("light: there is none; give at least one sky or directional light")

    def radiance(self, directions: Array) -> Array:
        """Radiance [N,3] from `directions` [N,3], of all that has a size."""
        return radiance(self.skies, self.suns, directions)

    def turned(self, degrees: float, up: str) -> "Lighting":
        """All of it turned by `degrees` about `up`, counter-clockwise seen from above."""
        turn = environment.rotation(degrees, up)
        if degrees == 0.0:
            return self
        return Lighting(
            tuple(replace(sky, turn=turn @ sky.turn) for sky in self.skies),
            tuple(replace(sun, direction=turn @ sun.direction) for sun in self.suns),
        )

    def content_hash(self) -> str:
        """SHA-256 of all that decides the light."""
        digest = hashlib.sha256()
        for sky in self.skies:
            digest.update(json.dumps([sky.image.shape, sky.up, sky.turn.tolist()]).encode())
            digest.update(np.ascontiguousarray(sky.image, "<f4").tobytes())
            digest.update(b"" if sky.residual is None else np.ascontiguousarray(sky.residual, "<f8").tobytes())
        for sun in self.suns:
            numbers = [sun.direction.tolist(), sun.irradiance.tolist(), sun.angular_diameter]
            digest.update(json.dumps(numbers).encode())
        return digest.hexdigest()


def read_lighting(
    lights: str | Path | Iterable[str | Path],
    up: str = "y",
    rotate: float = 0.0,
    *,
    mend: bool = False,
    say: Callable[[str], None] = print,
    mesh: Mesh | None = None,
    most_rows: int | None = None,
    degree: int = 2,
) -> Lighting:
    """Read one light or several: lat-long pictures, lights files (.toml), `sun:x,y,z[:r,g,b][:degrees]` and
    `sphere:x,y,z:radius[:r,g,b]`, all turned by `rotate`.

    `mend` and `say` are those of `environment.open_environment`. `mesh` is the object, which sphere lights are taken as
    discs from the middle of (`sphere_lights`); `say` is told what that leaves out. Skies of more than `most_rows` that
    would take more than `WHOLE_BYTES` are held as smaller copies (`downsampled`), their harmonics to `degree` as exact
    as those of the whole. Raises LightError, ImageError and StorageError for what is none of these, QueryError where
    `lights` is empty or a sphere light comes without a mesh.
    """
    skies, suns = list[Sky](), list[DirectionalLight]()

    def add(light: DirectionalLight | SphereLight, name: str) -> None:
        sun = light if isinstance(light, DirectionalLight) else as_disc(light, mesh, name, say)
        if not sun.irradiance.any():
            say(f"{name}: is black: it gives no light")
        suns.append(sun)

    for light in [lights] if isinstance(lights, str | Path) else lights:
        if str(light).startswith(("sun:", "sphere:")):
            parse = parse_sun if str(light).startswith("sun:") else parse_sphere
            add(parse(str(light)), f"--light {light}")
        elif Path(light).suffix.lower() == ".toml":
            for one in read_lights(light):
                if isinstance(one, SkyLight):
                    with errors_at(Path(light), "sky.file"):
                        skies.append(_read_sky(one, up, mend, say, most_rows, degree))
                else:
                    add(one, str(light))
        elif Path(light).suffix.lower() not in READABLE:
            raise LightError(
                f"{light}: is no light; expected a lat-long sky (.exr, .hdr or .png), a lights file (.toml), "
                f"{SUN_SYNTAX} or {SPHERE_SYNTAX}"
            )
        else:
            skies.append(_read_sky(SkyLight(Path(light), 0.0, 0.0, (1.0, 1.0, 1.0)), up, mend, say, most_rows, degree))
    return Lighting(tuple(skies), tuple(suns)).turned(rotate, up)


def _read_sky(
    light: SkyLight, up: str, mend: bool, say: Callable[[str], None], most_rows: int | None, degree: int
) -> Sky:
    opened = environment.open_environment(light.path, mend, say, _TO_MEND)
    factor = 2.0**light.exposure * np.asarray(light.tint)
    residual = None
    fits = 12 * opened.height * opened.width <= WHOLE_BYTES
    if most_rows is None or opened.height <= most_rows or fits:
        image = opened.whole()
    else:
        image, residual = shrink(opened, most_rows, degree, up)
        residual *= factor
    # A large sky is not copied for nothing.
    if not np.all(factor == 1.0):
        with np.errstate(over="ignore"):  # what no longer fits is told by the check
            image *= np.asarray(factor, np.float32)
        environment.check(image, light.path)
        if not np.any(factor):
            say(f"{light.path}: with its exposure and tint it is black: it gives no light")
    return Sky(image, up, environment.rotation(light.rotate, up), residual)


def as_lighting(light: ArrayLike | Lighting, up: str, rotate: float) -> Lighting:
    """A lat-long picture [H,W,3] as a lighting, or a lighting as it is, turned by `rotate` degrees about `up`."""
    if isinstance(light, Lighting):
        return light.turned(rotate, up)
    refuse_path("light", light, "prt.read_lighting")
    image = np.asarray(light, np.float32)
    environment.check(image, "light")
    return Lighting((Sky(image, up, environment.rotation(rotate, up)),))


def radiance(skies: Iterable[Sky], suns: Iterable[DirectionalLight], directions: Array) -> Array:
    """Radiance [N,3] from `directions` [N,3] of skies and of directional lights with a size."""
    total = np.zeros(directions.shape)
    for sky in skies:
        total += sky.radiance(directions)
    for sun in suns:
        if sun.angular_diameter > 0.0:
            total[in_disc(sun, directions)] += sun.irradiance / solid_angle(sun)
    return total


def in_disc(sun: DirectionalLight, directions: Array) -> NDArray[np.bool_]:
    """Whether `directions` [N,3], unit, fall on the light's disc [N]."""
    # By the chord: near the axis the cosine has no digits left to tell small angles apart.
    apart = directions - sun.direction
    chord = 2.0 * math.sin(math.radians(sun.angular_diameter) / 4.0)
    return np.asarray(np.einsum("ni,ni->n", apart, apart) <= chord * chord) & (sun.angular_diameter > 0.0)


def solid_angle(sun: DirectionalLight) -> float:
    """Of the light's disc, steradians."""
    return 4.0 * math.pi * math.sin(math.radians(sun.angular_diameter) / 4.0) ** 2
