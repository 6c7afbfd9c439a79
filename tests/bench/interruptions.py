"""Interrupted bakes: whether resumed assets are bit-identical, and the time that each accident costs.

    python -m tests.bench.interruptions [--bakes 10] [--kills 3] [--seed 0]

A small object with a slow transport. Bakes are killed (SIGKILL) at random moments and resumed with one or two workers
and another block size; a worker of a cluster is killed, or its scheduler; the disk fills up, as in the tests. `lost` is
the time of an accident: all seconds spent less those of the undisturbed bake, without the start of Python.
"""

import argparse
import errno
import logging
import os
import random
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import prt_bake.baking.adaptive.adaptive_job
from formats.errors import ClusterError, StorageError
from prt_bake import bake
from tests.bakers.transports import icosphere
from tests.baking.killing import KINDS, Slow, ended, process
from tests.baking.test_cluster import Processes, after_first_block
from tests.baking.test_resume import GROUPS, contents

SMALL = {"rings": 2, "sectors": 16}
FULL = {"for a block": "formats.journal.np.savez", "for the asset": "formats.asset.asset_file.AssetFile.close"}
"""The function that fails on a full disk."""
SUBDIVISIONS, PAUSE = 2, 5e-7
"""Subdivisions of the mesh (162 vertices), and least seconds of an evaluation."""


def identical(one: Path, other: Path) -> dict[str, bool]:
    """Whether two assets are bit-identical, by group."""
    found, expected = contents(one), contents(other)
    same = {name: found[name].tobytes() == values.tobytes() for name, values in expected.items()}
    return {group: all(good for name, good in same.items() if name.startswith(group)) for group in GROUPS}


class Row:
    """The table's row of one kind of accident."""

    def __init__(self, name: str) -> None:
        self.name, self.accidents, self.bakes, self.lost = name, 0, 0, list[float]()
        self.same = dict.fromkeys(GROUPS, 0)
        self.left = set[str]()

    def add(self, accidents: int, lost: float, same: dict[str, bool], left: set[str]) -> None:
        """Add a bake: its accidents, the time they cost, and the files left beside assets."""
        self.bakes, self.accidents, self.left = self.bakes + 1, self.accidents + accidents, self.left | left
        self.lost.append(lost / max(1, accidents))
        for group, good in same.items():
            self.same[group] += good

    def print(self, seconds: float) -> None:
        """Print the row; `seconds` is the time of the undisturbed bake."""
        same = "".join(f"{many:>7}/{self.bakes}" for many in self.same.values())
        middle = sorted(self.lost)[len(self.lost) // 2]
        print(
            f"{self.name:44}{self.accidents:10}{seconds:8.2f}{middle:8.2f}{max(self.lost):8.2f}{same}"
            f"  {', '.join(sorted(self.left)) or 'nothing left'}",
            flush=True,
        )


def left_in(folder: Path, assets: int) -> set[str]:
    """Names of the files in a folder beside its assets."""
    there = {path.name for path in folder.iterdir()}
    return {name for name in there if not name.endswith(".h5")} | (set() if len(there) >= assets else {"too few"})


def killed(kind: str, bakes: int, kills: int, draw: random.Random) -> None:
    """Bakes that are killed and resumed."""
    row = Row(f"killed, {kind}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        undisturbed = folder / "undisturbed.h5"
        seconds = _finished(undisturbed, kind, 5)
        for number in range(bakes):
            out, spent, many = folder / f"{number}.h5", 0.0, 0
            died = True
            while died and many < kills:
                moment, began = draw.uniform(0.0, 1.0) * seconds, time.perf_counter()
                child = process(out, kind, draw.randint(1, 2), draw.randint(1, 9), SUBDIVISIONS, PAUSE)
                died = ended(child, lambda moment=moment: time.sleep(moment))
                spent, many = spent + time.perf_counter() - began, many + died
            if died:
                spent += _finished(out, kind, draw.randint(1, 9))
            row.add(many, spent - seconds, identical(out, undisturbed), left_in(folder, 2))
            out.unlink()
    row.print(seconds)


def _finished(out: Path, kind: str, block: int) -> float:
    began = time.perf_counter()
    _child, status = os.waitpid(process(out, kind, 1, block, SUBDIVISIONS, PAUSE), 0)
    if status:
        raise SystemExit(f"{kind}: a resumed bake ended with status {status}")
    return time.perf_counter() - began


@contextmanager
def small_blocks() -> Iterator[None]:
    """Blocks of five vertices."""
    with (
        mock.patch.object(prt_bake.baking.adaptive.adaptive_job, "BINS_AT_ONCE", 5 * 32),
        mock.patch("bakers.baker.vertices_at_once", return_value=5),
    ):
        yield


def clustered(kind: str, bakes: int) -> None:
    """Bakes by two worker processes, one of which is killed, or their scheduler."""
    import dask

    for name in ("a worker of a cluster killed", "the scheduler killed"):
        row, taken = Row(f"{name}, {kind}"), list[float]()
        for _bake in range(bakes):
            with (
                tempfile.TemporaryDirectory() as folder,
                small_blocks(),
                dask.config.set({"distributed.comm.timeouts.connect": "2s"}),
            ):
                processes, place = Processes(Path(folder)), Path(folder) / "out"
                place.mkdir()
                try:
                    processes.start_workers(2)
                    # The workers import their modules in the first bake.
                    _timed(kind, place / "first.h5", scheduler=processes.address)
                    taken.append(_timed(kind, place / "undisturbed.h5", scheduler=processes.address))
                    act = processes.workers[0].kill if "worker" in name else processes.end
                    how = {"scheduler": processes.address, "progress": after_first_block(act)}
                    spent = _timed(kind, place / "a.h5", **how)
                    if not (place / "a.h5").exists():
                        spent += _timed(kind, place / "a.h5", workers=2, resume=True)
                finally:
                    processes.end()
                row.add(1, spent - taken[-1], identical(place / "a.h5", place / "undisturbed.h5"), left_in(place, 3))
        row.print(sorted(taken)[len(taken) // 2])


def _timed(kind: str, out: Path, **how: object) -> float:
    """Seconds of a bake, which may fail with its cluster or on a full disk."""
    began = time.perf_counter()
    try:
        bake(Slow(PAUSE), icosphere(SUBDIVISIONS), **SMALL, **KINDS[kind], out=out, **how).close()  # type: ignore[arg-type]
    except (ClusterError, StorageError) as early:
        if "resume" not in str(early) and "full" not in str(early):
            raise
    return time.perf_counter() - began


def filled_up(kind: str, bakes: int, draw: random.Random) -> None:
    """Bakes on a disk that is full after some blocks, or before the asset is written."""
    import numpy as np

    save = np.savez
    for name, target in FULL.items():
        row = Row(f"disk full {name}, {kind}")
        with tempfile.TemporaryDirectory() as folder, small_blocks():
            place = Path(folder)
            seconds = _timed(kind, place / "undisturbed.h5")
            for _bake in range(bakes):
                left = [draw.randint(1, 8) if "block" in name else 0]

                def full(*args: object, left: list[int] = left, **arrays: object) -> None:
                    left[0] -= 1
                    if left[0] < 0:
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                    save(*args, **arrays)  # type: ignore[arg-type]

                with mock.patch(target, full):
                    spent = _timed(kind, place / "a.h5")
                spent += _timed(kind, place / "a.h5", resume=True)
                row.add(1, spent - seconds, identical(place / "a.h5", place / "undisturbed.h5"), left_in(place, 2))
                (place / "a.h5").unlink()
        row.print(seconds)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bakes", type=int, default=10)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    draw = random.Random(args.seed)
    # The cluster logs its own end.
    logging.disable(logging.CRITICAL)
    import distributed  # noqa: F401  # its settings must exist before one of them is changed

    heads = "".join(f"/{group}".rjust(10) for group in GROUPS)
    print(f"{'accident':44}{'accidents':>10}{'bake s':>8}{'lost s':>8}{'most':>8}{heads}  files left")
    for kind in KINDS:
        killed(kind, args.bakes, args.kills, draw)
    for kind in ("error", "samples"):
        clustered(kind, max(1, args.bakes // 5))
        filled_up(kind, max(1, args.bakes // 3), draw)


if __name__ == "__main__":
    main()
