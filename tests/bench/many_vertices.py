"""Time and memory of bakes by the number of vertices: an analytic transport on a ring at 4×8 view bins, to disk.

    python -m tests.bench.many_vertices [--side 320 1000] [--samples 32] [--error 0.01]

Time should be linear in the vertices and memory nearly constant. Each bake has its own process, whose peak resident
memory is printed, with that of the mesh alone.
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
    """Peak resident memory so far [MiB]."""
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
    estimated, spent = asset.provenance["estimated_relative_rmse"]["total"], asset.provenance["evaluations"] / bins
    effort = f"{samples} samples" if error is None else f"error {error:.1%}"
    print(
        f"{vertices:9,} vertices, {effort}: estimated error {estimated:.2%}, {spent:.1f} evaluations per bin, "
        f"{seconds:.0f} s ({1e6 * seconds / vertices:.0f} µs per vertex), {size / 2**20:.0f} MiB on disk, "
        f"peak memory {resident():.0f} MiB ({before:.0f} before)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, nargs="+", default=[320, 1000])
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--error", type=float, default=0.01)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--one", choices=("samples", "error"))
    args = parser.parse_args()
    if args.one is not None:
        by_error = args.one == "error"
        one(args.side[0], None if by_error else args.samples, args.error if by_error else None, args.workers)
        return
    for side in args.side:
        for effort in ("samples", "error"):
            settings = ["--samples", str(args.samples), "--error", str(args.error), "--workers", str(args.workers)]
            alone = [sys.executable, "-m", "tests.bench.many_vertices", "--one", effort, "--side", str(side)]
            subprocess.run([*alone, *settings], check=True)


if __name__ == "__main__":
    main()
