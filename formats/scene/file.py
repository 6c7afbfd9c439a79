"""Reads the tables of a scene file (TOML, https://toml.io/en/v1.0.0) and describes their faults."""

import difflib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from formats.errors import PrtbakeError, SceneError
from formats.file_names import named_file
from formats.scene.lights import TABLES
from formats.scene.schema import InsideTable, InterfaceTable, MediumTable, MixTable, ObjectTable, SceneFile, Table
from formats.scene.toml import read_toml

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_EXPECTED = {
    "object": "a table [object]",
    "interface": "a table [interface]",
    "medium": "a table [medium]",
    "inside": "tables [[inside]]",
    "mesh": "the name of a mesh file",
    "up": '"y" or "z"',
    "unit": "the name of the unit of length",
    "eta": "an index of refraction from 0.25 to 4",
    "roughness": "a GGX alpha from 0 to 1, or the name of an image",
    "energy_compensation": "true or false",
    "normals": '"face" or "vertex"',
    "unit_in_mm": "a positive number of millimetres",
    "material": "the name of a measured material",
    "density": "a positive number",
    "mix": "a table [medium.mix]",
    "mix.sigma_t": "one number that is not negative, or three of them (RGB)",
    "mix.albedo": "a number from 0 to 1, or three of them (RGB)",
    "pattern": '"noise", "veins" or "turbulence"',
    "feature": "a positive length in scene units",
    "seed": "an integer from 0 to 2^63 - 1",
    "octaves": "an integer from 1 to 10",
    "thresholds": "two numbers, the lower one first",
    "resolution": "an integer number of cells from 2 to 256",
    "sigma_t": "one number that is not negative, three of them (RGB), or the name of an .npy grid",
    "albedo": "a number from 0 to 1, three of them (RGB), or the name of an .npy grid",
    "phase_g": "a mean cosine between -1 and 1, both excluded",
    "bounds": "two corners, as in [[-1, -1, -1], [1, 1, 1]]",
    "name": "a name",
    "in": "the name of another object",
    "surface": '"diffuse"',
    "reflectance": "a number from 0 to 1, three of them (RGB), or the name of an image",
}
_INSTEAD = "give the extinction sigma_t = sigma_s + sigma_a and the albedo = sigma_s / sigma_t"
_COEFFICIENTS = {"sigma_s": _INSTEAD, "sigma_a": _INSTEAD}


def parse_scene(path: Path) -> SceneFile:
    """Read the tables of a scene file and check every key and range, without opening the files that it names.

    Raises:
        SceneError: invalid TOML, an unknown or missing key, a value of the wrong type or out of range.
        StorageError: the file is missing.
    """
    tables = _read_tables(path)
    try:
        return SceneFile.model_validate(tables)
    except ValidationError as cause:
        raise SceneError(f"{path}: {_sentences(cause, tables)[0]}") from cause


def find_table_faults(path: Path) -> list[str]:
    """Return the faults of all keys of a scene file, a sentence each; raises as `parse_scene` for invalid TOML."""
    tables = _read_tables(path)
    try:
        SceneFile.model_validate(tables)
    except ValidationError as cause:
        return [f"{path}: {sentence}" for sentence in _sentences(cause, tables)]
    return []


def _read_tables(path: Path) -> dict[str, Any]:
    tables = read_toml(path, SceneError, "a scene file")
    if "object" not in tables and tables.keys() & TABLES:
        raise SceneError(
            f"{path}: is a lights file; expected a scene, with [object]; a lights file is the light of a picture"
        )
    return tables


def _sentences(fault: ValidationError, tables: Mapping[str, object]) -> list[str]:
    """Return the first fault of each key; unknown keys come first, since a misspelt key makes another one missing."""
    errors = sorted(fault.errors(), key=lambda error: error["type"] != "extra_forbidden")
    sentences: dict[str, str] = {}
    for error in errors:
        path, found = _locate(error["loc"], tables)
        sentences.setdefault(".".join(str(part) for part in path), _sentence(error, path, found))
    return list(sentences.values())


def _sentence(error: "ErrorDetails", path: list[int | str], found: object) -> str:
    kind, name = error["type"], str(path[-1])
    key = ".".join(str(part) for part in path)
    if kind == "extra_forbidden":
        if name in _COEFFICIENTS:
            return f"{key}: unknown key; {_COEFFICIENTS[name]}"
        known = _known_keys(path)
        close = difflib.get_close_matches(name, known, n=1)
        advice = f"did you mean '{close[0]}'?" if close else f"expected one of {', '.join(known)}"
        return f"{key}: unknown key; {advice}"
    if kind == "missing" and len(path) == len(error["loc"]):
        return f"{key}: is missing; expected {expected(key)}"
    if kind == "value_error":
        return f"{key}: {error['msg'].removeprefix('Value error, ')}"
    return f"{key}: expected {expected(key)}, found {found!r}"


def expected(key: str) -> str:
    """Describe the values that a key such as "medium.albedo" may have."""
    names = [part for part in key.split(".") if not part.isdigit()]
    return _EXPECTED.get(".".join(names[-2:])) or _EXPECTED[names[-1]]


def refuse_quoted_number(path: Path, key: str, name: str) -> None:
    """Raise SceneError if the name of a file is a number, and there is no such file."""
    try:
        float(name)
    except ValueError:
        return
    if not named_file(path, name).exists():
        raise SceneError(
            f"{path}: {key}: there is no file {name!r}; a number has no quotes: {key.rsplit('.', 1)[-1]} = {name}"
        )


@contextmanager
def errors_at(path: Path, key: str) -> Iterator[None]:
    """Put the scene file and the key that names another file before the errors of reading that file."""
    try:
        yield
    except PrtbakeError as fault:
        if str(fault).startswith(f"{path}: "):
            raise
        raise type(fault)(f"{path}: {key}: {fault}") from fault


def _locate(loc: tuple[int | str, ...], tables: Mapping[str, object]) -> tuple[list[int | str], object]:
    """Return the key of an error, without what pydantic appends (union members, array items), and its value."""
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
    tables: dict[str, type[Table]] = {
        "object": ObjectTable,
        "interface": InterfaceTable,
        "medium": MediumTable,
        "mix": MixTable,
        "inside": InsideTable,
    }
    names = [part for part in path[:-1] if isinstance(part, str)]
    model = tables[names[-1]] if names else SceneFile
    return [field.alias or name for name, field in model.model_fields.items()]
