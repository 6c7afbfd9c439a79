"""What a scene file may say: the tables of the TOML, their keys and ranges, and the words for what is wrong."""

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, field_validator

from formats.errors import SceneError
from formats.whole import existing

_Unit = Annotated[float, Field(ge=0, le=1)]
_Extinction = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Coordinate = Annotated[float, Field(allow_inf_nan=False)]
_Point = Annotated[tuple[_Coordinate, _Coordinate, _Coordinate], Strict(False)]
_Colour = Annotated[tuple[_Unit, _Unit, _Unit], Strict(False)]

_EXPECTED = {
    "object": "a table [object]",
    "interface": "a table [interface]",
    "medium": "a table [medium]",
    "inside": "tables [[inside]]",
    "mesh": "the name of a mesh file",
    "up": '"y" or "z"',
    "unit": "the name of the unit of length",
    "eta": "an index of refraction from 0.25 to 4",
    "roughness": "a GGX alpha from 0 to 1",
    "normals": '"face" or "vertex"',
    "sigma_t": "one number that is not negative, or the name of an .npy grid",
    "albedo": "a number from 0 to 1, three of them (RGB), or the name of an .npy grid",
    "phase_g": "a mean cosine between -1 and 1, both excluded",
    "bounds": "two corners, as in [[-1, -1, -1], [1, 1, 1]]",
    "name": "a name",
    "in": "the name of another object",
    "surface": '"diffuse"',
    "reflectance": "a number from 0 to 1, three of them (RGB), or the name of an image",
}


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, populate_by_name=True)


class ObjectTable(_Table):
    """[object]: the outer surface, a mesh file relative to the scene file."""

    mesh: str = Field(min_length=1)
    up: Literal["y", "z"] = "y"
    unit: str = "unit"


class InterfaceTable(_Table):
    """[interface]: the dielectric boundary; index-matched if left out."""

    eta: float = Field(default=1.0, ge=0.25, le=4)
    roughness: _Unit = 0.0
    normals: Literal["face", "vertex"] = "face"


class MediumTable(_Table):
    """[medium]: what scatters and absorbs; a string names a grid file."""

    sigma_t: _Extinction | str
    albedo: _Unit | _Colour | str
    phase_g: float = Field(default=0.0, gt=-1, lt=1)
    bounds: Annotated[tuple[_Point, _Point], Strict(False)] | None = None

    @field_validator("sigma_t", mode="before")
    @classmethod
    def _one_extinction(cls, value: object) -> object:
        if isinstance(value, list):
            raise ValueError("extinction by channel is not supported yet; give one number or the name of a grid")
        return value

    @field_validator("bounds")
    @classmethod
    def _ascending(cls, value: tuple[_Point, _Point] | None) -> tuple[_Point, _Point] | None:
        if value is not None and not all(low < high for low, high in zip(*value, strict=True)):
            raise ValueError("the lowest corner must come first and be below the highest in x, y and z")
        return value


class InsideTable(_Table):
    """[[inside]]: an object inside the object, nested by `in`."""

    name: str
    mesh: str = Field(min_length=1)
    inside_of: str | None = Field(default=None, alias="in")
    surface: Literal["diffuse"] | None = None
    reflectance: _Unit | _Colour | str | None = None
    interface: InterfaceTable | None = None
    medium: MediumTable | None = None


class SceneFile(_Table):
    """A whole scene file."""

    object: ObjectTable
    interface: InterfaceTable = InterfaceTable()
    medium: MediumTable
    inside: Annotated[tuple[InsideTable, ...], Strict(False)] = ()


def parse_scene(path: Path) -> SceneFile:
    """Read a scene file's tables and check every key and range; the files it names are not opened.

    Raises:
        SceneError: no TOML, an unknown or missing key, a value of the wrong type or out of range.
        StorageError: the file is missing.
    """
    try:
        tables = tomllib.loads(existing(path).read_bytes().decode("utf-8"))
    except UnicodeDecodeError as cause:
        raise SceneError(f"{path}: is not a scene file: it is not text") from cause
    except tomllib.TOMLDecodeError as cause:
        raise SceneError(f"{path}: is not TOML: {cause}") from cause
    try:
        return SceneFile.model_validate(tables)
    except ValidationError as cause:
        raise SceneError(f"{path}: {_sentence(cause, tables)}") from cause


def _sentence(fault: ValidationError, tables: Mapping[str, object]) -> str:
    """Tell the first fault by its key; unknown keys come first, since a misspelt key also makes another one missing."""
    errors = sorted(fault.errors(), key=lambda error: error["type"] != "extra_forbidden")
    path, found = _located(errors[0]["loc"], tables)
    kind, name = errors[0]["type"], str(path[-1])
    key = ".".join(str(part) for part in path)
    if kind == "extra_forbidden":
        known = _known_keys(path)
        close = difflib.get_close_matches(name, known, n=1)
        advice = f"did you mean '{close[0]}'?" if close else f"expected one of {', '.join(known)}"
        return f"{key}: unknown key; {advice}"
    if kind == "missing" and len(path) == len(errors[0]["loc"]):
        return f"{key}: is missing; expected {_EXPECTED[name]}"
    if kind == "value_error":
        return f"{key}: {errors[0]['msg'].removeprefix('Value error, ')}"
    return f"{key}: expected {_EXPECTED[name]}, found {found!r}"


def _located(loc: tuple[int | str, ...], tables: Mapping[str, object]) -> tuple[list[int | str], object]:
    """Cut what pydantic adds to a location (members of a union, items of an array) and return it with its value."""
    path: list[int | str] = []
    value: object = tables
    for part in loc:
        if isinstance(value, Mapping):
            value = value.get(str(part))
        elif isinstance(value, list) and isinstance(part, int) and path == ["inside"]:
            value = value[part]
        else:
            break
        path.append(part)
    return path, value


def _known_keys(path: list[int | str]) -> list[str]:
    tables: dict[str, type[_Table]] = {
        "object": ObjectTable,
        "interface": InterfaceTable,
        "medium": MediumTable,
        "inside": InsideTable,
    }
    names = [part for part in path[:-1] if isinstance(part, str)]
    model = tables[names[-1]] if names else SceneFile
    return [field.alias or name for name, field in model.model_fields.items()]
