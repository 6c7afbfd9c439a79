"""Describes and checks a file of any kind: mesh, sky, scene, lights, model, importance module, asset or samples.

The module of each kind has `describe(path)` and `find_faults(path)`.
"""

import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

from formats import image, mesh
from formats.atomic import existing
from formats.errors import FormatError, PrtbakeError
from formats.scene.lights import TABLES

SUFFIXES = {
    "mesh": mesh.READABLE,
    "sky": image.READABLE,
    "scene": (".toml",),
    "model": (".pt", ".safetensors", ".onnx"),
    "asset": (".h5", ".hdf5"),
}
CHECKPOINT = ".train.pt"
"""How the name of a training's checkpoint ends."""


def kind_of(path: str | Path) -> str:
    """Return "mesh", "sky", "scene", "lights", "model", "importance", "asset" or "samples".

    The suffix decides. A name that ends in .importance.pt is an importance module; an HDF5 file names its own kind, and
    the tables of a .toml file do.

    Raises:
        StorageError: there is no such file.
        FormatError: no kind has this suffix, or the file is the checkpoint of a training.
    """
    suffix = existing(path).suffix.lower()
    if Path(path).name.lower().endswith(CHECKPOINT):
        raise FormatError(f"{path}: is the checkpoint of a training, for `prtbake train --resume`; give its model")
    if suffix in SUFFIXES["model"] and Path(path).stem.endswith(".importance"):
        return "importance"
    if suffix == ".toml":
        return kind_of_toml(path) or "scene"
    for kind, suffixes in SUFFIXES.items():
        if suffix in suffixes:
            return "samples" if kind == "asset" and _is_samples(path) else kind
    known = ", ".join(suffix for suffixes in SUFFIXES.values() for suffix in suffixes)
    raise FormatError(f"{path}: unknown suffix {suffix!r}; expected one of {known}")


def describe(path: str | Path) -> dict[str, Any]:
    """Return the contents of a file as plain JSON values under readable names; lengths are in scene units.

    Raises:
        PrtbakeError: the file cannot be read as the kind that its suffix names.
    """
    kind = kind_of(path)
    named = "picture" if kind == "sky" else "function" if _is_function(path) else kind  # not every picture is a sky
    return {"kind": named, "bytes": Path(path).stat().st_size, **_module(kind, path).describe(Path(path))}


def find_faults(path: str | Path) -> list[str]:
    """Return every fault of a file as a sentence; an empty list means that the file is sound.

    Raises:
        StorageError: there is no such file.
        FormatError: no kind has this suffix.
    """
    kind = kind_of(path)
    try:
        faults: list[str] = _module(kind, path).find_faults(Path(path))
    except PrtbakeError as error:
        return [str(error)]
    return faults


def find_remarks(path: str | Path) -> list[str]:
    """Return remarks on a sound file as sentences; only meshes, scenes and ONNX functions have some.

    Raises:
        PrtbakeError: the file cannot be read as the kind that its suffix names.
    """
    kind = kind_of(path)
    if kind not in ("mesh", "scene") and not _is_function(path):
        return []
    remarks: list[str] = _module(kind, path).find_remarks(Path(path))
    return remarks


def kind_of_toml(path: str | Path) -> str | None:
    """Return "scene" or "lights" by the tables of a file; None if they are those of neither, or it is not TOML."""
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return None
    return "scene" if "object" in tables else "lights" if tables.keys() & TABLES else None


def _is_samples(path: str | Path) -> bool:
    from formats.samples import is_samples

    return is_samples(path)


def _is_function(path: str | Path) -> bool:
    return Path(path).suffix.lower() == ".onnx"


def _module(kind: str, path: str | Path) -> Any:
    """Import the module of one kind alone: that of models loads torch."""
    return import_module(f"prt_bake.inspection.{'function' if _is_function(path) else kind}")
