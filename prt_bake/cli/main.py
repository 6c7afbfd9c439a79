"""`prtbake`: the commands under one name, and what a user sees when one of them fails."""

import os
import shlex
import sys
from collections.abc import Callable, Sequence

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.bake import bake
from prt_bake.cli.check import check
from prt_bake.cli.compare import compare
from prt_bake.cli.compress import compress
from prt_bake.cli.demo import demo
from prt_bake.cli.export import export
from prt_bake.cli.importance import importance
from prt_bake.cli.info import describe
from prt_bake.cli.light import light
from prt_bake.cli.render import render
from prt_bake.cli.report import report
from prt_bake.cli.sample import sample
from prt_bake.cli.shade import shade
from prt_bake.cli.train import train
from prt_bake.cli.view import view

# Help in plain text: the styled one loads rich, which takes longer than everything else.
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
    "train": train,
    "sample": sample,
    "importance": importance,
    "bake": bake,
    "compress": compress,
    "light": light,
    "shade": shade,
    "view": view,
    "render": render,
    "compare": compare,
    "info": describe,
    "check": check,
    "export": export,
}
for name, command in COMMANDS.items():
    app.command(name, no_args_is_help=name != "demo")(command)

app.add_typer(report, name="report")

INTERRUPTED = 130  # what typer makes of a KeyboardInterrupt that no command has caught


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit code: 0 done, 1 failed (one line on stderr), 2 wrong usage.

    Everything a user can cause ends in one line; any other exception is a defect and keeps its traceback.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        app(args=words, prog_name="prtbake", obj=shlex.join(["prtbake", *words]))
    except SystemExit as ending:
        if ending.code != INTERRUPTED:
            return int(ending.code or 0)
        return _fail("stopped by Ctrl-C before it was done")
    except PrtbakeError as fault:
        return _fail(str(fault))
    except OSError as fault:
        return _fail(_sentence(fault))
    except MemoryError:
        return _fail("out of memory: try a smaller mesh, fewer --workers or a smaller --size")
    return 0


def run() -> None:
    """Entry point of the console script."""
    sys.exit(main())


def _fail(sentence: str) -> int:
    print("prtbake:", " ".join(sentence.split()), file=sys.stderr)
    return 1


def _sentence(fault: OSError) -> str:
    """The operating system's words, after the file they are about."""
    reason = os.strerror(fault.errno) if fault.errno else str(fault)
    return f"{fault.filename}: {reason}" if fault.filename is not None else reason
