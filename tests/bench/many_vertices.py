"""Cost linear in vertices, in flat memory: analytic transports on a ring of V vertices at 4×8 view bins, to disk.

    python -m tests.bench.many_vertices [--side 320 1000] [--samples 32] [--error 0.01]

Each bake in a process of its own, whose largest resident memory is printed, and how much of it the mesh alone takes.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.bakers.transports import Lobed
from tests.shapes import ring


def resident() -> float:
    """Largest resident memory so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def one(side: int, samples: int | None, error: float | None, workers: int) -> None:
    from prt_bake import bake

    mesh = ring(around=side, across=side)
    before = resident()
    with tempfile.TemporaryDirectory() as folder:
        out, began = Path(folder) / "asset.h5", time.perf_counter()
        settings = {"samples": samples} if error is None else {"error": error}
        asset = bake(Lobed(), mesh, rings=4, sectors=8, out=out, workers=workers, **settings)
        seconds, size = time.perf_counter() - began, out.stat().st_size
    vertices, bins = len(mesh.positions), len(mesh.positions) * 32
    told, spent = asset.provenance["estimated_relative_rmse"]["total"], asset.provenance["evaluations"] / bins
    way = f"{samples} samples" if error is None else f"error {error:.1%}"
    print(
        f"{vertices:9,} vertices, {way}: {told:.2%} told, {spent:.1f} evaluations a bin, {seconds:.0f} s "
        f"({1e6 * seconds / vertices:.0f} µs a vertex), {size / 2**20:.0f} MiB on disk, resident {resident():.0f} MiB "
        f"({before:.0f} before)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, nargs="+", default=[320, 1000])
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--error", type=float, default=0.01)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--one", choices=("samples", "error"))
    given = parser.parse_args()
    if given.one is not None:
        by_error = given.one == "error"
        one(given.side[0], None if by_error else given.samples, given.error if by_error else None, given.workers)
        return
    for side in given.side:
        for way in ("samples", "error"):
            settings = ["--samples", str(given.samples), "--error", str(given.error), "--workers", str(given.workers)]
            subprocess.run([sys.executable, __file__, "--one", way, "--side", str(side), *settings], check=True)


if __name__ == "__main__":
    main()
