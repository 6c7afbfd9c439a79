"""The serial part of a bake: seconds of each stage on one core, and the predicted time with many workers.

    python -m tests.bench.scaling --model prt_bake/shipped/spot.pt --mesh prt_bake/shipped/spot.obj --error 0.01

Workers do the blocks, the pilot and the survey. Threads of the main process pack the asset's chunks and write blocks to
the journal. The rest is serial. Everything runs on one core, which should be idle otherwise.
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
NAMES = {"refined_block": "blocks", "_timed_block": "pilot", "_survey_vertex": "survey"}
IN_THREADS = "packing", "journal"
SECONDS: Counter[str] = Counter()


class Timed(Threads):
    """A single worker whose time is measured."""

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


def measure(stage: str, owner: Any, name: str) -> None:
    """Measure the time of a function under the name of its stage."""
    work = getattr(owner, name)

    def measured(*args: Any, **options: Any) -> Any:
        with timed(stage):
            return work(*args, **options)

    setattr(owner, name, measured)


@contextmanager
def one_worker(*_settings: Any) -> Iterator[Timed]:
    yield Timed(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--mesh", type=Path, required=True)
    parser.add_argument("--error", type=float, default=0.01)
    args = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    prt_bake.baking.bake.open_workers = one_worker
    measure("pruning", prt_bake.baking.bake, "choose_pruning")
    measure("preparing the pilot", prt_bake.baking.adaptive.run, "first_refinement")
    measure("tolerances", prt_bake.baking.adaptive.run, "settings_for_error")
    measure("packing", formats.asset.chunk_writer, "_compress")
    measure("journal", Journal, "write")
    measure("asset written", prt_bake.baking.adaptive.run, "write_asset")
    mesh = read_mesh(args.mesh)
    transport = open_source(args.model, mesh, "cpu", None)
    with tempfile.TemporaryDirectory() as folder, timed("total"):
        prt_bake.baking.bake.bake(
            transport, mesh, error=args.error, out=Path(folder) / "a.h5", leave_out=prt_bake.baking.bake.ITEMS
        )
    total = SECONDS.pop("total")
    for stage, part in (("preparing the pilot", "survey"), ("tolerances", "pilot"), ("asset written", "packing")):
        SECONDS[stage] -= SECONDS[part]
    SECONDS["other"] = total - SECONDS.total()
    shared = sum(SECONDS[stage] for stage in (*NAMES.values(), *IN_THREADS))
    print("| stage | seconds on one core | done by |\n|---|---|---|")
    for stage, seconds in SECONDS.most_common():
        by = "workers" if stage in NAMES.values() else "threads" if stage in IN_THREADS else "serial"
        print(f"| {stage} | {seconds:.2f} | {by} |")
    print(f"| total | {total:.2f} | |\n\n| workers | seconds | serial share |\n|---|---|---|")
    for workers in WORKERS:
        predicted = total - shared + shared / workers
        print(f"| {workers} | {predicted:.1f} | {(total - shared) / predicted:.0%} |")


if __name__ == "__main__":
    main()
