"""The last line of a command: the one to type next, with the user's own file names."""

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

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


def say_next_of_asset(asset: Path) -> None:
    """Print the command that shows an asset: in a window, without a display in a file, without PyVista by `shade`."""
    picture = asset.with_suffix(".png")
    if picture.exists():
        picture = asset.with_name(f"{asset.stem}.view.png")
    if not all(map(find_spec, ("pyvista", "vtkmodules"))):
        from prt_bake.shipped.examples import example

        say_next("prtbake", "shade", asset, "--light", example("sky.hdr"), "-o", picture)
    elif sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        say_next("prtbake", "view", asset, "--screenshot", picture)
    else:
        say_next("prtbake", "view", asset)
