"""`prtbake`: the list of commands, and the errors that they print."""

import os
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Annotated, Any

import typer

from formats.errors import InputWarning, PrtbakeError
from formats.version import program_version
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
from prt_bake.cli.shared import signals
from prt_bake.cli.shared.help import Groups
from prt_bake.cli.shared.progress import say
from prt_bake.cli.shared.verbose import detail, error_detail, verbosely
from prt_bake.cli.start.example import example
from prt_bake.cli.start.init import init
from prt_bake.cli.start.materials import materials
from prt_bake.cli.train import train
from prt_bake.cli.view import view
from prt_bake.jit import notice

# The help is plain text: styled help would import rich, which takes longer than everything else.
app = typer.Typer(
    name="prtbake",
    cls=Groups,
    help="Bake translucent objects into assets that any engine can relight.",
    epilog="`prtbake COMMAND --help` explains a command. Exit codes: 0 done, 1 failed, 2 wrong usage, 130 Ctrl-C.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
COMMANDS: dict[str, dict[str, Callable[..., None]]] = {
    "Main commands": {"init": init, "train": train, "bake": bake, "shade": shade, "view": view},
    "In one step": {"make": make, "demo": demo, "example": example},
    "Make assets": {"sample": sample, "importance": importance, "lobes": lobes, "compress": compress},
    "Pictures and light": {"render": render, "light": light},
    "Measure": {"compare": compare},
    "Files": {"info": info, "check": check, "materials": materials, "export": export},
}
_WITHOUT_ARGUMENTS = ("demo", "materials")
for group, commands in COMMANDS.items():
    for name, command in commands.items():
        app.command(name, no_args_is_help=name not in _WITHOUT_ARGUMENTS, rich_help_panel=group)(command)

app.add_typer(report, name="report", rich_help_panel="Measure")

INTERRUPTED = 130  # typer's exit code for a KeyboardInterrupt that no command has caught


def _print_version(requested: bool) -> None:
    if requested:
        print(f"prtbake {program_version()}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print versions, times and origins of messages; also after COMMAND.")
    ] = False,
) -> None:
    """The options of `prtbake` itself. `main` takes --verbose out of the command line before it is parsed."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit code: 0 success, 1 failure (one line on stderr), 2 wrong usage.

    A command that received a signal ends with 128 plus its number: 130 after Ctrl-C, though it kept what it had.

    Every error that a user can cause is printed as one line. Any other exception is a defect and keeps its traceback.
    """
    signals.forget()
    notice.say = say
    command_line = sys.argv[1:] if arguments is None else list(arguments)
    if strange := [text for text in command_line if not _is_utf_8(text)]:
        return _fail(f"expected names in UTF-8, which OpenEXR and HDF5 require, found {strange[0]!a}; rename the file")
    parsed, is_verbose = _without_verbose(command_line)
    with verbosely(is_verbose):
        return signals.exit_code(_run(parsed, shlex.join(["prtbake", *command_line])))


def _without_verbose(command_line: list[str]) -> tuple[list[str], bool]:
    """Return the arguments without --verbose, which may stand anywhere before a --, and whether it was there."""
    end = command_line.index("--") if "--" in command_line else len(command_line)
    kept = [text for text in command_line[:end] if text not in ("-v", "--verbose")]
    return kept + command_line[end:], len(kept) < end


def _run(command_line: list[str], typed: str) -> int:
    try:
        with _printed_warnings():
            _parser()(args=command_line, prog_name="prtbake", obj=typed)
    except SystemExit as ending:
        if ending.code != INTERRUPTED:
            return int(ending.code or 0)
        _print_line(signals.sentence())
        return INTERRUPTED
    except PrtbakeError as error:
        error_detail()
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


@cache
def _parser() -> Callable[..., Any]:
    """Return the commands with their options. A call of `app` would build them again, which takes as long as `info`."""
    return typer.main.get_command(app)


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
                detail(f"this warning is from {args[0]}, line {args[1]}")

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
