"""Runs a bake in child processes, kills them at random times, and resumes.

    python killing.py FOLDER KIND SEED

Prints how many were killed. Each process has another number of workers and another block size. Writes whole.h5, baked
in one run, and killed.h5 to the folder.
"""

import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bakers.baker
import prt_bake.baking.adaptive.adaptive_job
from prt_bake import bake
from tests.bakers.transports import Array, Incoherent, icosphere

KILLS = 6
KINDS: dict[str, dict[str, Any]] = {
    "error": {"error": 0.08},
    "samples": {"samples": 32, "storage": "float32", "lobes": 4},
    "error by samples": {"error": 0.5, "directions": "uniform", "samples": 16},
}


class Slow(Incoherent):
    """A transport that takes `pause` seconds per evaluation, so that a kill can hit any moment of a bake."""

    def __init__(self, pause: float = 2e-7) -> None:
        self.pause = pause

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        time.sleep(self.pause * incident.shape[0] * incident.shape[1])
        return super().evaluate(incident, positions, outgoing)


def process(out: Path, kind: str, workers: int, block: int, subdivisions: int = 1, pause: float = 2e-7) -> int:
    """Starts a process that bakes and resumes from what there is; returns its id."""
    child = os.fork()
    if child:
        return child
    prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE = block * 32
    bakers.baker.vertices_at_once = lambda bins, directions: block
    mesh = icosphere(subdivisions)
    bake(Slow(pause), mesh, rings=2, sectors=16, **KINDS[kind], out=out, workers=workers, resume=True)
    os._exit(0)


def ended(child: int, wait: Callable[[], None] = lambda: None) -> bool:
    """Waits and kills the process; whether it was still running."""
    wait()
    if os.waitpid(child, os.WNOHANG)[0]:
        return False
    os.kill(child, signal.SIGKILL)
    return os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL


def main(folder: Path, kind: str, seed: int) -> None:
    began = time.monotonic()
    os.waitpid(process(folder / "whole.h5", kind, 1, 5), 0)
    seconds, draw, killed = time.monotonic() - began, random.Random(seed), 0
    for _kill in range(KILLS):
        moment = draw.uniform(0.0, 0.6) * seconds
        child = process(folder / "killed.h5", kind, draw.randint(1, 3), draw.randint(1, 9))
        killed += ended(child, lambda moment=moment: time.sleep(moment))
        if not (folder / "killed.h5.journal").exists() and (folder / "killed.h5").exists():
            break
    kept = len(list(folder.glob("killed.h5.journal/*.npz")))
    _child, status = os.waitpid(process(folder / "killed.h5", kind, 2, draw.randint(1, 9)), 0)
    assert status == 0
    print(killed, kept)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
