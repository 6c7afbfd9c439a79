"""Checks of a command's outputs, before it computes anything: none is an input, and each can be written."""

import os
import shutil
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from formats.atomic import create_folder, refuse_unwritable, storage_error
from formats.errors import StorageError
from formats.file_names import named_file
from prt_bake.cli.shared.progress import say

Paths = Path | str | Iterable[Path | str] | None
"""The value of an option or argument; None and texts that name no file, such as sun:0,1,0, are left out."""


def check_outputs(outputs: Mapping[str, Paths], inputs: Mapping[str, Paths], folder: Path | None = None) -> None:
    """Refuse outputs that would overwrite an input or one another, or that cannot be written.

    Inputs are also the files that a scene, a lights file or a glTF file names. Links to an input, and its name in
    other letters where the file system ignores case, are refused too.

    Args:
        outputs: the files to write, by the option that they belong to.
        inputs: the files to read, by argument or option.
        folder: the folder of the outputs, which is created if it is missing.

    Raises StorageError that names the path and both options.
    """
    written = [(option, path) for option, paths in outputs.items() for path in _paths(paths)]
    _refuse_twice(written)
    _refuse_inputs(written, inputs)
    if folder is not None:
        create_folder(folder)
    for _, path in written:
        refuse_unwritable(path)
    _refuse_closed_folders(path for _, path in written)


def refuse_existing(paths: Iterable[Path], force: bool, resume: bool | None = None) -> None:
    """Refuse to replace files that took long to compute, unless `force` or `resume` is true.

    Pictures and reports are replaced, as every renderer does. Call it after `check_outputs`.

    Args:
        paths: the files to write.
        force: the option --force.
        resume: the option --resume, None for commands that have none.

    Raises StorageError that names the first file that exists, and the options that help.
    """
    if force or resume:
        return
    for path in paths:
        if path.exists():
            other = "" if resume is None else ", or --resume to continue"
            raise StorageError(f"{path}: already exists; add --force to replace it{other}")


def warn_of_small_disk(path: Path, most: int) -> None:
    """Print a message if the disk of an output has less space left than the `most` bytes that the work may need."""
    left = shutil.disk_usage(os.path.dirname(os.path.realpath(path))).free
    if left < most:
        say(
            f"{path}: may need up to {most / 1e6:,.1f} MB of its disk while it is written, where {left / 1e6:,.1f} MB "
            "are left"
        )


def _paths(paths: Paths) -> list[Path]:
    if paths is None:
        return []
    return [Path(paths)] if isinstance(paths, Path | str) else [Path(path) for path in paths]


def _refuse_twice(written: list[tuple[str, Path]]) -> None:
    options: dict[str, str] = {}
    for option, path in written:
        other = options.setdefault(os.path.normcase(os.path.realpath(path)), option)
        if other != option:
            raise StorageError(
                f"{path}: would be written both as {other} and as {option}; choose another name for one of them"
            )


def _refuse_inputs(written: list[tuple[str, Path]], inputs: Mapping[str, Paths]) -> None:
    read: dict[tuple[int, int], str] = {}
    for argument, paths in inputs.items():
        for path in _paths(paths):
            for file, source in _with_named(path, f"given as {argument}"):
                if (key := _identity(file)) is not None:
                    read.setdefault(key, source)
    for _, path in written:
        key = _identity(path)
        if key in read:
            raise StorageError(f"{path}: is also the input {read[key]}; choose another name for the output")


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what `os.path.samefile` compares: equal for all names of and links to one file; None without a file."""
    try:
        status = os.stat(os.path.realpath(path))  # finds none/../file, where the folder is yet to be made
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def _with_named(path: Path, source: str) -> Iterator[tuple[Path, str]]:
    """Yield the file and the files that it names, each with words for where it comes from."""
    yield path, source
    # Scenes name meshes, and meshes name neither scenes nor meshes: so there are no circles.
    others = (".toml",) if path.suffix.lower() == ".toml" else (".toml", ".gltf", ".glb")
    for named in _named_in(path):
        if named.suffix.lower() not in others:
            yield from _with_named(named, f"named by {path}")


def _named_in(path: Path) -> list[Path]:
    """Return the texts of a TOML file as paths, or the files that a glTF file names; none if it is damaged."""
    try:
        if path.suffix.lower() == ".toml":
            return [named_file(path, text) for text in _texts(tomllib.loads(path.read_text(encoding="utf-8-sig")))]
        if path.suffix.lower() in (".gltf", ".glb"):
            from formats.mesh.gltf import named_files  # here, since meshes need NumPy

            return named_files(path)
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        pass  # the reader reports it
    return []


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _texts(item)


def _refuse_closed_folders(paths: Iterable[Path]) -> None:
    """Create and remove a file without a name in each folder, since permissions alone do not decide."""
    tried = set[str]()
    for path in paths:
        folder = os.path.dirname(os.path.realpath(path))
        if folder in tried:
            continue
        tried.add(folder)
        try:
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as cause:
            raise storage_error(path, cause) from cause
