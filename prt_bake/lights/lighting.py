"""Lightings: skies and directional lights together, their radiance in a direction, and their content hash.

A directional light of irradiance E and angular diameter a has the radiance E / Ω over its disc,
Ω = 2π (1 − cos a/2), with exact edges. A light without size has no radiance in any direction; walks connect to it.
"""

import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import described, numbers
from formats.errors import LightError, QueryError, refuse_path, warn
from formats.image import READABLE
from formats.json_report import as_line
from formats.mesh import Mesh
from formats.scene.file import errors_at
from formats.scene.lights import (
    WORDS,
    DirectionalLight,
    SkyLight,
    SphereLight,
    parse_word,
    read_lights,
)
from formats.summary import summary
from prt_bake.lights import environment
from prt_bake.lights.skies.downsampled import shrink
from prt_bake.lights.sphere_lights import as_disc
from prt_bake.mathematics import sh

Array = NDArray[np.float64]

_REMEDY = "repair the picture, or have it repaired as it is read (--mend; mend=True in Python)"
_UNIT_TOLERANCE = 1e-3
"""Largest deviation of a direction's length from 1."""
MAX_BYTES = 512 << 20
"""Larger skies are downsampled. For smaller ones a copy would take longer to make than it saves."""


@dataclass(frozen=True, eq=False)
class Sky:
    """A lat-long picture [H,W,3] of radiance with its up axis, rotated to object space by `turn` [3,3].

    residual: harmonics [K,3], before the rotation, of the original picture minus those of `image`, if `image` is a
    downsampled copy; else None.
    """

    image: NDArray[np.float32]
    up: str
    turn: Array
    residual: Array | None = None

    @property
    def to_object(self) -> Array:
        """The rotation [3,3] from the polar frame of the picture to object space."""
        return np.asarray(self.turn @ environment.FROM_POLAR[self.up])

    def radiance(self, directions: Array) -> Array:
        """Radiance [N,3] from `directions` [N,3]."""
        return environment.lookup(self.image, directions @ self.turn, self.up)

    __repr__ = summary


@dataclass(frozen=True, eq=False)
class Lighting:
    """Skies and directional lights together, as `read_lighting` returns them.

    Raises QueryError if there is no light, and for lights of other kinds.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> lighting = prt.read_lighting("sun:0,1,0:3,3,3:0.5")
    >>> lighting.suns[0].irradiance.tolist()
    [3.0, 3.0, 3.0]
    >>> bool(lighting.radiance(np.array([[1.0, 0.0, 0.0]])).any())  # no light from the side
    False
    """

    skies: tuple[Sky, ...] = ()
    suns: tuple[DirectionalLight, ...] = ()

    def __post_init__(self) -> None:
        for name, kind in (("skies", Sky), ("suns", DirectionalLight)):
            value = getattr(self, name)
            lights = tuple(value) if isinstance(value, list | tuple) else (value,)
            if wrong := [each for each in lights if not isinstance(each, kind)]:
                raise QueryError(
                    f"{name}: expected those of a lighting, found {described(wrong[0])}; prt.read_lighting([...]) "
                    "reads several lights together"
                )
            object.__setattr__(self, name, lights)
        if not self.skies and not self.suns:
            raise QueryError("light: there is none; give at least one sky or directional light")

    def radiance(self, directions: Array) -> Array:
        """Radiance [N,3] from unit `directions` [N,3], of all lights that have a size."""
        towards = np.asarray(numbers("directions", directions), np.float64)
        if towards.ndim != 2 or towards.shape[1] != 3:
            raise QueryError(f"directions: expected shape [N, 3], found {list(towards.shape)}")
        off = ~(np.abs(np.linalg.norm(towards, axis=1) - 1.0) <= _UNIT_TOLERANCE)
        if off.any():
            first = towards[off.argmax()].tolist()
            raise QueryError(f"directions: expected unit vectors, found {int(off.sum())} that are not, such as {first}")
        return radiance(self.skies, self.suns, towards)

    def turned(self, degrees: float, up: str) -> "Lighting":
        """The lighting rotated by `degrees` about `up`, counter-clockwise seen from above."""
        turn = environment.rotation(degrees, up)
        if degrees == 0.0:
            return self
        return Lighting(
            tuple(replace(sky, turn=turn @ sky.turn) for sky in self.skies),
            tuple(replace(sun, direction=turn @ sun.direction) for sun in self.suns),
        )

    def content_hash(self) -> str:
        """SHA-256 of all lights."""
        digest = hashlib.sha256()
        for sky in self.skies:
            digest.update(as_line([sky.image.shape, sky.up, sky.turn.tolist()]).encode())
            digest.update(np.ascontiguousarray(sky.image, "<f4").tobytes())
            digest.update(b"" if sky.residual is None else np.ascontiguousarray(sky.residual, "<f8").tobytes())
        for sun in self.suns:
            numbers = [sun.direction.tolist(), sun.irradiance.tolist(), sun.angular_diameter]
            digest.update(as_line(numbers).encode())
        return digest.hexdigest()

    __repr__ = summary


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
    """Read one or several lights, all rotated by `rotate` degrees about `up`.

    Args:
        lights: one or several: a lat-long picture, a lights file (.toml), `sun:x,y,z[:r,g,b][:degrees]` or
            `sphere:x,y,z:radius[:r,g,b]`.
        up: the axis that points up, "y" or "z".
        rotate: degrees, counter-clockwise seen from above.
        mend: repairs bad pixels of skies (`prt_bake.read_environment`).
        say: called with warnings.
        mesh: the object; sphere lights become discs seen from its middle.
        most_rows: a sky with more rows and more than 512 MiB is downsampled; None for no limit.
        degree: harmonics of a downsampled sky stay exact to this degree.

    Raises LightError, ImageError or StorageError for a light that cannot be read, QueryError if `lights` is empty or a
    sphere light has no mesh.

    >>> import prt_bake as prt
    >>> sky = prt.example("sky.hdr")
    >>> lighting = prt.read_lighting([sky, "sun:0,1,0:3,2.8,2.5:0.53"], rotate=90.0)
    >>> len(lighting.skies), len(lighting.suns)
    (1, 1)
    """
    skies, suns = list[Sky](), list[DirectionalLight]()

    def add(light: DirectionalLight | SphereLight, name: str) -> None:
        sun = light if isinstance(light, DirectionalLight) else as_disc(light, mesh, name, say)
        if not sun.irradiance.any():
            say(f"{name}: is black: it gives no light")
        suns.append(sun)

    for light in [lights] if isinstance(lights, str | Path) else lights:
        if (word := parse_word(str(light))) is not None:
            add(word, f"light {light}")
        elif Path(light).suffix.lower() == ".toml":
            for one in read_lights(light):
                if isinstance(one, SkyLight):
                    with errors_at(Path(light), "sky.file"):
                        skies.append(_read_sky(one, up, mend, say, most_rows, degree))
                else:
                    add(one, str(light))
        elif Path(light).suffix.lower() not in READABLE:
            raise LightError(
                f"{light}: is not a light; expected a lat-long sky (.exr, .hdr, .png or .jpg), a lights file (.toml), "
                f"{' or '.join(syntax for syntax, _ in WORDS.values())}"
            )
        else:
            skies.append(_read_sky(SkyLight(Path(light), 0.0, 0.0, (1.0, 1.0, 1.0)), up, mend, say, most_rows, degree))
    return Lighting(tuple(skies), tuple(suns)).turned(rotate, up)


def _read_sky(
    light: SkyLight, up: str, mend: bool, say: Callable[[str], None], most_rows: int | None, degree: int
) -> Sky:
    opened = environment.open_environment(light.path, mend, say, _REMEDY)
    factor = 2.0**light.exposure * np.asarray(light.tint)
    residual = None
    fits = 12 * opened.height * opened.width <= MAX_BYTES
    if most_rows is None or opened.height <= most_rows or fits:
        image = opened.read()
    else:
        to_object = sh.rotation(environment.from_polar(up), degree)
        image, residual = shrink(opened, most_rows, degree)
        residual = (to_object @ residual) * factor
    # A factor of 1 is skipped, to save time on large skies.
    if not np.all(factor == 1.0):
        lit = image.any()
        with np.errstate(over="ignore", invalid="ignore"):
            image *= np.asarray(factor, np.float32)
        if not np.isfinite(image).all():
            raise LightError(f"{light.path}: its exposure and tint make it brighter than numbers can be; lower them")
        if lit and not image.any():
            say(f"{light.path}: its exposure and tint make it black: it gives no light")
    return Sky(image, up, environment.rotation(light.rotate, up), residual)


def as_lighting(light: ArrayLike | Lighting, up: str, rotate: float) -> Lighting:
    """The lighting of a lat-long picture [H,W,3], or a given lighting, rotated by `rotate` degrees about `up`."""
    if isinstance(light, Lighting):
        warn_of_other_up(light, up)
        return light.turned(rotate, up)
    refuse_path("light", light, "prt.read_lighting")
    image = np.asarray(light, np.float32)
    environment.check(image, "light")
    return Lighting((Sky(image, up, environment.rotation(rotate, up)),))


def warn_of_other_up(lighting: Lighting, up: str) -> None:
    """Issue an InputWarning if a sky was read for another axis than the one that points up here."""
    other = next((sky.up for sky in lighting.skies if sky.up != up), None)
    if other is not None:
        warn(
            f"light: its sky stands upright with {other} up, but {up} points up here; read it with "
            f'prt.read_lighting(path, up="{up}")'
        )


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
    """Whether unit `directions` [N,3] are on the light's disc [N]."""
    # By the chord: near the axis the cosine has too few digits for small angles.
    difference = directions - sun.direction
    chord = 2.0 * math.sin(math.radians(sun.angular_diameter) / 4.0)
    return np.asarray(np.einsum("ni,ni->n", difference, difference) <= chord * chord) & (sun.angular_diameter > 0.0)


def solid_angle(sun: DirectionalLight) -> float:
    """The solid angle of the light's disc, steradians."""
    return 4.0 * math.pi * math.sin(math.radians(sun.angular_diameter) / 4.0) ** 2
