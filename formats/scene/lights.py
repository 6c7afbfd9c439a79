"""Lights: TOML files (https://toml.io/en/v1.0.0) of suns, spheres and skies, and lights as `sun:x,y,z` text.

`sun:…` and `sphere:…` describe one light in one word of the command line.
"""

import difflib
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError

from formats.errors import LightError
from formats.file_names import named_file
from formats.mesh.geometry import MOST_COORDINATE
from formats.scene.toml import read_toml

_Number = Annotated[float, Field(allow_inf_nan=False)]
_BRIGHTEST = 1e30
"""Brighter lights would overflow the float32 of pictures."""
_Irradiance = Annotated[float, Field(ge=0, le=_BRIGHTEST, allow_inf_nan=False)]
_Vector = Annotated[tuple[_Number, _Number, _Number], Strict(False)]
_Coordinate = Annotated[float, Field(ge=-MOST_COORDINATE, le=MOST_COORDINATE)]
_Position = Annotated[tuple[_Coordinate, _Coordinate, _Coordinate], Strict(False)]
_Colour = Annotated[tuple[_Irradiance, _Irradiance, _Irradiance], Strict(False)]

_EXPECTED = {
    "directional": "tables [[directional]]",
    "sphere": "tables [[sphere]]",
    "sky": "tables [[sky]]",
    "direction": "three finite numbers [x, y, z], not all 0, that point to the light",
    "irradiance": "three numbers [r, g, b] from 0 to 1e30",
    "angular_diameter": "degrees from 0 to 180",
    "position": "three numbers [x, y, z] within ±1e30, in scene units",
    "radius": "a number above 0 and up to 1e30, in scene units",
    "radiance": "three numbers [r, g, b] from 0 to 1e30",
    "file": "the name of a lat-long image",
    "rotate": "degrees",
    "exposure": "stops from -64 to 64",
    "tint": "three numbers [r, g, b] from 0 to 1e30",
}
SUN_SYNTAX = "sun:x,y,z[:r,g,b][:degrees]"
SPHERE_SYNTAX = "sphere:x,y,z:radius[:r,g,b]"


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Light from one direction.

    Attributes:
        direction: unit vector towards the light, object space [3].
        irradiance: linear RGB [3], radiance times solid angle: that of a surface perpendicular to the direction, if the
            light is narrow.
        angular_diameter: of the disc in the sky, in degrees; 0 is a point at infinity.
    """

    direction: NDArray[np.float64]
    irradiance: NDArray[np.float64]
    angular_diameter: float


@dataclass(frozen=True, eq=False)
class SphereLight:
    """A sphere of constant radiance; its power is 4π² radius² radiance.

    Attributes:
        position: centre, object space [3].
        radius: in scene units.
        radiance: linear RGB [3], the same in every direction.
    """

    position: NDArray[np.float64]
    radius: float
    radiance: NDArray[np.float64]


@dataclass(frozen=True)
class SkyLight:
    """A lat-long image, rotated by `rotate` degrees about the up axis, its radiance times 2^exposure and `tint`."""

    path: Path
    rotate: float
    exposure: float
    tint: tuple[float, float, float]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class _DirectionalTable(_Table):
    direction: _Vector
    irradiance: _Colour = (1.0, 1.0, 1.0)
    angular_diameter: float = Field(default=0.0, ge=0, le=180)


class _SphereTable(_Table):
    position: _Position
    radius: float = Field(gt=0, le=MOST_COORDINATE)
    radiance: _Colour = (1.0, 1.0, 1.0)


class _SkyTable(_Table):
    file: str = Field(min_length=1)
    rotate: float = Field(default=0.0, allow_inf_nan=False)
    exposure: float = Field(default=0.0, ge=-64, le=64)
    tint: _Colour = (1.0, 1.0, 1.0)


class _LightsFile(_Table):
    directional: Annotated[tuple[_DirectionalTable, ...], Strict(False)] = ()
    sphere: Annotated[tuple[_SphereTable, ...], Strict(False)] = ()
    sky: Annotated[tuple[_SkyTable, ...], Strict(False)] = ()


TABLES = frozenset(_LightsFile.model_fields)
"""The tables that a lights file may have."""
_TABLES: dict[str, type[_Table]] = {
    "": _LightsFile,
    "directional": _DirectionalTable,
    "sphere": _SphereTable,
    "sky": _SkyTable,
}


def read_lights(path: str | os.PathLike[str]) -> tuple[DirectionalLight | SphereLight | SkyLight, ...]:
    """Read a lights file: its [[directional]] lights, its [[sphere]] lights, then its [[sky]] images.

    Paths of images are relative to the file; the images are not opened.

    Raises:
        LightError: invalid TOML, an unknown or missing key, a value out of range, no light at all.
        StorageError: the file is missing.
    """
    path = Path(path)
    tables = read_toml(path, LightError, "a lights file")
    try:
        lights = _LightsFile.model_validate(tables)
    except ValidationError as cause:
        raise LightError(f"{path}: {_sentence(cause, tables)}") from cause
    if not (lights.directional or lights.sphere or lights.sky):
        raise LightError(f"{path}: has no light; expected [[directional]], [[sphere]] or [[sky]]")
    directional = tuple(
        _directional(f"{path}: directional.{i}", light.direction, light.irradiance, light.angular_diameter)
        for i, light in enumerate(lights.directional)
    )
    spheres = (
        SphereLight(np.array(sphere.position), sphere.radius, np.array(sphere.radiance)) for sphere in lights.sphere
    )
    skies = (SkyLight(named_file(path, sky.file), sky.rotate, sky.exposure, sky.tint) for sky in lights.sky)
    return (*directional, *spheres, *skies)


def parse_sun(text: str) -> DirectionalLight:
    """Parse `sun:x,y,z[:r,g,b][:degrees]`; the default irradiance is 1, the default angular diameter 0.

    Raises:
        LightError: another syntax, or a value out of range.
    """
    numbers = _numbers(text)
    if [len(field) for field in numbers] not in ([3], [3, 3], [3, 1], [3, 3, 1]):
        raise LightError(f"light {text}: expected {SUN_SYNTAX}, such as sun:0,1,0.5:3,3,2.8:0.53")
    irradiance = numbers[1] if len(numbers) > 1 and len(numbers[1]) == 3 else [1.0, 1.0, 1.0]
    diameter = numbers[-1][0] if len(numbers[-1]) == 1 else 0.0
    if not all(0 <= value <= _BRIGHTEST for value in irradiance):
        raise LightError(f"light {text}: irradiance: expected {_EXPECTED['irradiance']}, found {irradiance}")
    if not 0 <= diameter <= 180:
        raise LightError(f"light {text}: angular diameter: expected degrees from 0 to 180, found {diameter:g}")
    return _directional(f"light {text}", numbers[0], irradiance, diameter)


def parse_sphere(text: str) -> SphereLight:
    """Parse `sphere:x,y,z:radius[:r,g,b]`; the default radiance is 1.

    Raises:
        LightError: another syntax, or a value out of range.
    """
    numbers = _numbers(text)
    if [len(field) for field in numbers] not in ([3, 1], [3, 1, 3]):
        raise LightError(f"light {text}: expected {SPHERE_SYNTAX}, such as sphere:0,3,1:0.25:40,36,30")
    position, (radius,), radiance = numbers if len(numbers) == 3 else (*numbers, [1.0, 1.0, 1.0])
    if not all(abs(value) <= MOST_COORDINATE for value in position):
        raise LightError(f"light {text}: position: expected {_EXPECTED['position']}, found {position}")
    if not 0 < radius <= MOST_COORDINATE:
        raise LightError(f"light {text}: radius: expected {_EXPECTED['radius']}, found {radius:g}")
    if not all(0 <= value <= _BRIGHTEST for value in radiance):
        raise LightError(f"light {text}: radiance: expected {_EXPECTED['radiance']}, found {radiance}")
    return SphereLight(np.array(position), radius, np.array(radiance))


WORDS: dict[str, tuple[str, Callable[[str], DirectionalLight | SphereLight]]] = {
    "sun:": (SUN_SYNTAX, parse_sun),
    "sphere:": (SPHERE_SYNTAX, parse_sphere),
}
"""Lights in one word: how the word begins, its syntax, and the function that parses it."""


def parse_word(text: str) -> DirectionalLight | SphereLight | None:
    """Parse a light in one word, or return None for the name of a file.

    Raises:
        LightError: another syntax, or a value out of range.
    """
    parse = next((parse for start, (_, parse) in WORDS.items() if text.startswith(start)), None)
    return None if parse is None else parse(text)


def _numbers(text: str) -> list[list[float]]:
    """Return the numbers of each colon-separated field after the first; none if a field is malformed."""
    try:
        return [[float(number) for number in field.split(",")] for field in text.split(":")[1:]]
    except ValueError:
        return []


def _directional(where: str, direction: Any, irradiance: Any, diameter: float) -> DirectionalLight:
    vector = np.asarray(direction, np.float64)
    largest = float(np.abs(vector).max())
    if not (largest > 0 and math.isfinite(largest)):
        raise LightError(f"{where}: direction: expected {_EXPECTED['direction']}, found {vector.tolist()}")
    vector = vector / largest
    return DirectionalLight(vector / np.linalg.norm(vector), np.asarray(irradiance, np.float64), float(diameter))


def _sentence(fault: ValidationError, tables: dict[str, Any]) -> str:
    """Describe the first fault; unknown keys come first, since a misspelt key makes another one missing."""
    error = sorted(fault.errors(), key=lambda error: error["type"] != "extra_forbidden")[0]
    location = error["loc"][:3]
    key, name = ".".join(str(part) for part in location), str(location[-1])
    if error["type"] == "extra_forbidden":
        known = list(_TABLES[str(location[0]) if len(location) > 1 else ""].model_fields)
        close = difflib.get_close_matches(name, known, n=1)
        return f"{key}: unknown key; " + (f"did you mean '{close[0]}'?" if close else f"expected {', '.join(known)}")
    expected = _EXPECTED[name if name in _EXPECTED else str(location[0])]
    if error["type"] == "missing" and len(error["loc"]) == len(location):
        return f"{key}: is missing; expected {expected}"
    return f"{key}: expected {expected}, found {_value_at(tables, location)!r}"


def _value_at(tables: Any, location: tuple[int | str, ...]) -> Any:
    value = tables
    for part in location:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            break
    return value
