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

from formats.errors import QueryError
from formats.lights import DirectionalLight, parse_sun, read_lights
from formats.scene_file import named_by
from prt_bake import environment

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sky:
    """A lat-long picture [H,W,3] of radiance with its up axis; `turn` [3,3] takes its directions to object space."""

    image: NDArray[np.float32]
    up: str
    turn: Array

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
        for sun in self.suns:
            numbers = [sun.direction.tolist(), sun.irradiance.tolist(), sun.angular_diameter]
            digest.update(json.dumps(numbers).encode())
        return digest.hexdigest()


def read_lighting(
    lights: Iterable[str | Path],
    up: str = "y",
    rotate: float = 0.0,
    *,
    mend: bool = False,
    say: Callable[[str], None] = print,
) -> Lighting:
    """Read lights: lat-long pictures, lights files (.toml) and `sun:x,y,z[:r,g,b][:degrees]`, all turned by `rotate`.

    `mend` and `say` are those of `environment.read_environment`. Raises LightError, ImageError and StorageError for
    what is none of these, QueryError where `lights` is empty.
    """
    skies, suns = list[Sky](), list[DirectionalLight]()

    def add_sky(path: Path, degrees: float, factor: float | Array) -> None:
        image = environment.read_environment(path, mend, say)
        # A large sky is not copied for nothing.
        if not np.all(np.equal(factor, 1.0)):
            with np.errstate(over="ignore"):  # what no longer fits is told by the check
                image = image * np.asarray(factor, np.float32)
        environment.check(image, path)
        skies.append(Sky(image, up, environment.rotation(degrees, up)))

    for light in lights:
        if str(light).startswith("sun:"):
            suns.append(parse_sun(str(light)))
        elif Path(light).suffix.lower() == ".toml":
            for one in read_lights(light):
                if isinstance(one, DirectionalLight):
                    suns.append(one)
                else:
                    with named_by(Path(light), "sky.file"):
                        add_sky(one.path, one.rotate, 2.0**one.exposure * np.asarray(one.tint))
        else:
            add_sky(Path(light), 0.0, 1.0)
    return Lighting(tuple(skies), tuple(suns)).turned(rotate, up)


def as_lighting(light: ArrayLike | Lighting, up: str, rotate: float) -> Lighting:
    """A lat-long picture [H,W,3] as a lighting, or a lighting as it is, turned by `rotate` degrees about `up`."""
    if isinstance(light, Lighting):
        return light.turned(rotate, up)
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
