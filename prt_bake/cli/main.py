"""`prtbake`: the list of commands, and the errors that they print."""

import os
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import typer

from formats.errors import InputWarning, PrtbakeError
from prt_bake.cli.bake import bake
from prt_bake.cli.check import check
from prt_bake.cli.compare import compare
from prt_bake.cli.compress import compress
from prt_bake.cli.demo import demo
from prt_bake.cli.export import export
from prt_bake.cli.importance import importance
from prt_bake.cli.info import info
from prt_bake.cli.light import light
from prt_bake.cli.lobes import lobes
from prt_bake.cli.making.make import make
from prt_bake.cli.render import render
from prt_bake.cli.reports.group import report
from prt_bake.cli.sample import sample
from prt_bake.cli.shade import shade
from prt_bake.cli.start.init import init
from prt_bake.cli.start.materials import materials
from prt_bake.cli.train import train
from prt_bake.cli.view import view

# The help is plain text: styled help would import rich, which takes longer than everything else.
app = typer.Typer(
    name="prtbake",
    help="Bake translucent objects into assets that any engine can relight.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "init": init,
    "materials": materials,
    "make": make,
    "train": train,
    "sample": sample,
    "importance": importance,
    "bake": bake,
    "lobes": lobes,
    "compress": compress,
    "light": light,
    "shade": shade,
    "view": view,
    "render": render,
    "compare": compare,
    "info": info,
    "check": check,
    "export": export,
}
for name, command in COMMANDS.items():
    app.command(name, no_args_is_help=name not in ("demo", "materials"))(command)

app.add_typer(report, name="report")

INTERRUPTED = 130  # typer's exit code for a KeyboardInterrupt that no command has caught


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit code: 0 success, 1 failure (one line on stderr), 2 wrong usage.

    Every error that a user can cause is printed as one line. Any other exception is a defect and keeps its traceback.
    """
    command_line = sys.argv[1:] if arguments is None else list(arguments)
    if strange := [text for text in command_line if not _is_utf_8(text)]:
        return _fail(f"expected names in UTF-8, which OpenEXR and HDF5 require, found {strange[0]!a}; rename the file")
    try:
        with _printed_warnings():
            app(args=command_line, prog_name="prtbake", obj=shlex.join(["prtbake", *command_line]))
    except SystemExit as ending:
        if ending.code != INTERRUPTED:
            return int(ending.code or 0)
        return _fail("stopped by Ctrl-C before it was finished")
    except PrtbakeError as error:
        return _fail(str(error))
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        return _fail(reason if error.filename is None else f"{error.filename}: {reason}")
    except ValueError as error:
        if "threading layer" not in str(error).lower():  # numba, at the first kernel
            raise
        layer = os.environ.get("NUMBA_THREADING_LAYER")
        return _fail(f"NUMBA_THREADING_LAYER is {layer}, which numba cannot load here; unset it, or `pip install tbb`")
    except MemoryError:
        return _fail("out of memory: try a smaller mesh, fewer --workers or a smaller --size")
    return 0


@contextmanager
def _printed_warnings() -> Iterator[None]:
    """Print each InputWarning once, as one line on stderr; other warnings are shown as Python does."""
    printed = set()
    with warnings.catch_warnings():
        show = warnings.showwarning

        def show_once(message: Warning | str, category: type[Warning], *args: Any, **kwargs: Any) -> None:
            if not issubclass(category, InputWarning):
                show(message, category, *args, **kwargs)
            elif str(message) not in printed:
                printed.add(str(message))
                _print_line(f"warning: {message}")

        warnings.simplefilter("always", InputWarning)
        warnings.showwarning = show_once
        yield


def _is_utf_8(text: str) -> bool:
    """Return whether no byte of an argument was outside UTF-8; Python keeps such bytes as surrogates."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)


def _print_line(message: str) -> None:
    print("prtbake:", " ".join(message.split()), file=sys.stderr)


def _fail(message: str) -> int:
    _print_line(message)
    return 1
