"""Where the serial part of a bake lies: seconds of each stage on one core, and what 64 workers would make of it.

    python tests/bench/scaling.py --model prt_bake/shipped/spot.pt --mesh prt_bake/shipped/spot.obj --error 0.01

The blocks are what workers do; pilot, journal and the writing of the asset are done by the process that asked. Run it
on cores that do nothing else.
"""

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import prt_bake.bake_first_look
import prt_bake.bake_refined
import prt_bake.bake_to_error
import prt_bake.baking
from bakers.crew import Threads
from formats.journal import Journal
from formats.mesh import read_mesh
from prt_bake.sources import open_source

WORKERS = 1, 2, 8, 16, 64
SECONDS: Counter[str] = Counter()


class Timed(Threads):
    """One worker, whose time is kept."""

    def do(self, work: Callable[..., Any], shared: tuple[Any, ...], *own: Any) -> Any:
        with timed("blocks"):
            return super().do(work, shared, *own)


@contextmanager
def timed(stage: str) -> Iterator[None]:
    began = time.perf_counter()
    try:
        yield
    finally:
        SECONDS[stage] += time.perf_counter() - began


def watched(stage: str, owner: Any, name: str) -> None:
    """Keeps the time of a function by its stage."""
    work = getattr(owner, name)

    def watching(*arguments: Any, **named: Any) -> Any:
        with timed(stage):
            return work(*arguments, **named)

    setattr(owner, name, watching)


@contextmanager
def one_worker(*_asked: Any) -> Iterator[Timed]:
    yield Timed(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--mesh", type=Path, required=True)
    parser.add_argument("--error", type=float, default=0.01)
    asked = parser.parse_args()
    prt_bake.baking.opened_crew = one_worker
    watched("what is needed", prt_bake.baking, "needs_of")
    watched("first look", prt_bake.bake_to_error, "first_refinement")
    watched("pilot", prt_bake.bake_to_error, "aimed")
    watched("journal", Journal, "write")
    watched("asset written", prt_bake.bake_to_error, "_write")
    mesh = read_mesh(asked.mesh)
    transport = open_source(asked.model, mesh, "cpu", None)
    with tempfile.TemporaryDirectory() as folder, timed("in all"):
        prt_bake.baking.bake(
            transport, mesh, error=asked.error, out=Path(folder) / "a.h5", leave_out=prt_bake.baking.ITEMS
        )
    whole = SECONDS.pop("in all")
    SECONDS["the rest"] = whole - SECONDS.total()
    blocks = SECONDS["blocks"]
    print("| stage | seconds on one core |\n|---|---|")
    for stage, seconds in SECONDS.most_common():
        print(f"| {stage} | {seconds:.2f} |")
    print(f"| in all | {whole:.2f} |\n\n| workers | seconds | of that, serial |\n|---|---|---|")
    for workers in WORKERS:
        together = whole - blocks + blocks / workers
        print(f"| {workers} | {together:.1f} | {(whole - blocks) / together:.0%} |")


if __name__ == "__main__":
    main()
