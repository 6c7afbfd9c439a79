"""The last line of a command: the one to type next, with the user's own file names."""

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import chain, count
from pathlib import Path

from formats.errors import PrtbakeError

_silent = False


def command(*words: object) -> str:
    """A command as a user types it, with quotes where the shell needs them."""
    return shlex.join(map(str, words))


def say_next(*words: object) -> None:
    """Print a command on stderr; nothing inside `without_next`."""
    if not _silent:
        print(f"next: {command(*words)}", file=sys.stderr, flush=True)


@contextmanager
def without_next() -> Iterator[None]:
    """Context of a command that runs others, and goes on to the next one itself."""
    global _silent
    _silent = True
    try:
        yield
    finally:
        _silent = False


def unused(path: Path) -> Path:
    """Return the path, or the first of NAME_2, NAME_3, … if it exists: commands do not replace files unasked."""
    others = (path.with_name(f"{path.stem}_{number}{path.suffix}") for number in count(2))
    return next(name for name in chain([path], others) if not name.exists())


def say_next_of_asset(asset: Path, *options: object, lights: Sequence[object] = ()) -> None:
    """Print the command that shows an asset: in a window, without a display in a file, without PyVista by `shade`.

    `options` of both `view` and `shade`, and `lights`, are what the user gave; without lights it is the shipped sky.
    """
    picture = unused(asset.with_suffix(".png"))
    lit = [word for light in lights for word in ("--light", light)]
    if not all(map(find_spec, ("pyvista", "vtkmodules"))):
        from prt_bake.shipped.examples import example

        say_next("prtbake", "shade", asset, *(lit or ["--light", example("sky.hdr")]), *options, "-o", picture)
    elif sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        say_next("prtbake", "view", asset, *lit, *options, "--screenshot", picture)
    else:
        say_next("prtbake", "view", asset, *lit, *options)


def say_next_of_file(kind: str, file: Path) -> None:
    """Print the command that goes on with a mesh, a scene, a model or an asset, with what lies beside it already."""
    model, asset = file.with_suffix(".pt"), file.with_suffix(".h5")
    if kind == "mesh":
        from prt_bake.inspection.exported import glb_extras
        from prt_bake.inspection.mesh import needs_a_size

        if glb_extras(file) is not None:
            say_next("prtbake", "export", file, "-o", unused(file.with_suffix("")))
            return
        size = ("--size", "10cm") if needs_a_size(file) else ()
        scene = unused(usual := file.with_suffix(".toml"))
        say_next("prtbake", "init", file, "--material", "jade", *size, *(() if scene == usual else ("-o", scene)))
    elif kind == "scene" and not model.exists():
        say_next("prtbake", "train", file, "-o", model)
    elif file.suffix.lower() == ".onnx":
        say_next("prtbake", "bake", file, "MESH", "-o", unused(asset), "--convention", "incident, position, outgoing")
    elif kind in ("scene", "model") and not asset.exists():
        source = model if kind == "scene" else file
        say_next("prtbake", "bake", source, *(() if _knows_its_mesh(source) else ("MESH",)), "-o", asset)
    elif kind in ("scene", "model", "asset"):
        say_next_of_asset(file if kind == "asset" else asset)


def _knows_its_mesh(model: Path) -> bool:
    from prt_bake.baking.sources import own_mesh

    try:
        own_mesh(model)
    except (PrtbakeError, OSError):
        return False
    return True
