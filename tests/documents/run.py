"""Runs the commands of pages, each page in an empty folder: `python -m tests.documents.run [PAGE …]`.

`sh` blocks are run by `bash -e`, each in the folder where the one before ended; `python` blocks in one process, which
keeps their names. `--minutes N` becomes one minute, or two of `prtbake make`.
"""

import argparse
import linecache
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import textwrap
import time
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from tests import ROOT
from tests.documents.commands import Block, blocks, name, pages

MOST_SECONDS = 900
"""A block that takes longer has failed."""
_FAILED = "(failed)"


class PageResult(NamedTuple):
    """What became of a page: numbers of blocks run, reasons of the others, and a text for each that failed."""

    run: int
    not_run: list[str]
    seconds: float
    failures: list[str]


def main() -> int:
    """Run the pages named in the command line, or all; print a table and the output of what failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.documents.run", description=__doc__)
    parser.add_argument("pages", nargs="*", type=Path, metavar="PAGE", help="Markdown pages; by default all")
    arguments = parser.parse_args()
    failures = list[str]()
    print(f"{'page':<42}{'run':>4}{'seconds':>9}  not run")
    for page in [path.resolve() for path in arguments.pages] or pages():
        result = run_page(page)
        reasons = [f"{result.not_run.count(reason)} × {reason}" for reason in sorted(set(result.not_run))]
        print(f"{name(page):<42}{result.run:>4}{result.seconds:>9.1f}  {'; '.join(reasons)}")
        print("".join(f"    FAILED {text}\n" for text in result.failures), end="", flush=True)
        failures += result.failures
    print(f"{len(failures)} blocks failed" if failures else "every block ran")
    return 1 if failures else 0


def run_page(page: Path) -> PageResult:
    """Run every block of a page that is to be run, in an empty folder; those after one that failed, too."""
    found = blocks(page.read_text(encoding="utf-8"))
    not_run = [block.reason for block in found if block.reason is not None and block.language in ("sh", "python")]
    running = [block for block in found if block.runs]
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        failures = _failures(page, running, Path(folder).resolve()) if running else []
    return PageResult(len(running), not_run, time.monotonic() - start, failures)


def _failures(page: Path, running: list[Block], folder: Path) -> list[str]:
    """The line, code and output of every block that fails."""
    log = folder.with_name(folder.name + ".log")
    here, there = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_run_blocks, args=(there, page, folder, log))
    process.start()
    there.close()
    found = list[str]()
    for block in running:
        log.write_bytes(b"")
        code = shortened(block.code)
        here.send(block._replace(code=code))
        ending = _ending(here)
        if ending:
            text = f"{code}\n\n{log.read_text(encoding='utf-8', errors='replace')}{ending}"
            found.append(f"{name(page)}:{block.line + 1}\n" + textwrap.indent(text, "    | ", lambda _: True))
        if ending not in ("", _FAILED):
            process.terminate()
            break
    here.close()
    process.join()
    log.unlink()
    return found


def _ending(connection: Connection) -> str:
    """How a block ended: nothing if it succeeded."""
    if not connection.poll(MOST_SECONDS):
        return f"still running after {MOST_SECONDS} s; the blocks below it were not run"
    try:
        return "" if connection.recv() else _FAILED
    except EOFError:
        return "the process ended; the blocks below it were not run"


def shortened(code: str) -> str:
    """The code with at most a minute for every `--minutes` and `minutes=`, two for `prtbake make`."""

    def shorter(found: re.Match[str]) -> str:
        most = 2 if re.search(r"prtbake make\b", found[0]) else 1
        return re.sub(r"(minutes[ =])([\d.]+)", lambda each: f"{each[1]}{min(float(each[2]), most):g}", found[0])

    return re.sub(r".+", shorter, code.replace("\\\n", " "))


def _run_blocks(connection: Connection, page: Path, folder: Path, log: Path) -> None:
    """In a process of its own: run each block that is received, and send whether it succeeded."""
    os.chdir(folder)
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    os.environ["PYTHONPATH"] = str(ROOT)
    namespace = {"__name__": "__main__"}
    while True:
        try:
            block = connection.recv()
        except EOFError:
            return
        with open(log, "ab") as output:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
        connection.send(_shell(block.code) if block.language == "sh" else _python(block, page, namespace))


def _shell(code: str) -> bool:
    with tempfile.NamedTemporaryFile("r") as ending:
        line = ["bash", "-e", "-c", f"trap 'pwd > {ending.name}' EXIT\n{code}"]
        done = subprocess.run(line, stdin=subprocess.DEVNULL, check=False)
        os.chdir(ending.read().strip() or ".")
    return done.returncode == 0


def _python(block: Block, page: Path, namespace: dict[str, Any]) -> bool:
    linecache.checkcache()
    try:
        exec(compile("\n" * block.line + block.code, str(page), "exec"), namespace)
    except BaseException:
        traceback.print_exc()
        return False
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return True


if __name__ == "__main__":
    sys.exit(main())
