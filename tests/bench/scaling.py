"""Where the serial part of a bake lies: seconds of each stage on one core, and what many workers would make of it.

    python -m tests.bench.scaling --model prt_bake/shipped/spot.pt --mesh prt_bake/shipped/spot.obj --error 0.01

Blocks, pilot and survey are what workers do; chunks of the asset are packed, and blocks kept in the journal, in threads
of the process that asked; the rest is serial. Everything is done on one core, which should have nothing else to do.
"""

import argparse
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import formats.asset.chunk_writer
import prt_bake.baking.adaptive.run
import prt_bake.baking.bake
from bakers.workers import Threads
from formats.journal import Journal
from formats.mesh import read_mesh
from prt_bake.baking.sources import open_source

WORKERS = 1, 2, 8, 16, 64
NAMES = {"refined_block": "blocks", "_timed_block": "pilot", "_surveyed": "survey"}
IN_THREADS = "packing", "journal"
SECONDS: Counter[str] = Counter()


class Timed(Threads):
    """One worker, whose time is kept."""

    def do(self, work: Callable[..., Any], shared: tuple[Any, ...], *own: Any) -> Any:
        with timed(NAMES.get(work.__name__, work.__name__)):
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

    def watching(*args: Any, **named: Any) -> Any:
        with timed(stage):
            return work(*args, **named)

    setattr(owner, name, watching)


@contextmanager
def one_worker(*_asked: Any) -> Iterator[Timed]:
    yield Timed(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--mesh", type=Path, required=True)
    parser.add_argument("--error", type=float, default=0.01)
    args = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    prt_bake.baking.bake.open_workers = one_worker
    watched("what is needed", prt_bake.baking.bake, "choose_pruning")
    watched("first look", prt_bake.baking.adaptive.run, "first_refinement")
    watched("aim", prt_bake.baking.adaptive.run, "settings_for_error")
    watched("packing", formats.asset.chunk_writer, "_packed")
    watched("journal", Journal, "write")
    watched("asset written", prt_bake.baking.adaptive.run, "_write")
    mesh = read_mesh(args.mesh)
    transport = open_source(args.model, mesh, "cpu", None)
    with tempfile.TemporaryDirectory() as folder, timed("in all"):
        prt_bake.baking.bake(
            transport, mesh, error=args.error, out=Path(folder) / "a.h5", leave_out=prt_bake.baking.bake.ITEMS
        )
    whole = SECONDS.pop("in all")
    for stage, part in (("first look", "survey"), ("aim", "pilot"), ("asset written", "packing")):
        SECONDS[stage] -= SECONDS[part]
    SECONDS["the rest"] = whole - SECONDS.total()
    shared = sum(SECONDS[stage] for stage in (*NAMES.values(), *IN_THREADS))
    print("| stage | seconds on one core | done by |\n|---|---|---|")
    for stage, seconds in SECONDS.most_common():
        by = "workers" if stage in NAMES.values() else "threads" if stage in IN_THREADS else "serial"
        print(f"| {stage} | {seconds:.2f} | {by} |")
    print(f"| in all | {whole:.2f} | |\n\n| workers | seconds | of that, serial |\n|---|---|---|")
    for workers in WORKERS:
        together = whole - shared + shared / workers
        print(f"| {workers} | {together:.1f} | {(whole - shared) / together:.0%} |")


if __name__ == "__main__":
    main()
