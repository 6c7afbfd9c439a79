"""Cost of a bake by the requested error: evaluations per bin, refinement passes, and the estimated error.

    python -m tests.bench.errors_requested [--errors 0.1 0.05 0.03 0.02 0.01] [--seeds 3] \
        [--rings 4] [--sectors 8] [--model MODEL.pt --mesh MESH]

A coarser error must never cost more than a finer one.
"""

import argparse
import time
from pathlib import Path

import prt_bake
from formats.mesh import read_mesh
from prt_bake import bake
from prt_bake.network.bssrdf import load_model

SHIPPED = Path(prt_bake.__file__).parent / "shipped"


def main() -> None:
    """Print a row for each error and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--errors", type=float, nargs="+", default=[0.1, 0.05, 0.03, 0.02, 0.01])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rings", type=int, default=4)
    parser.add_argument("--sectors", type=int, default=8)
    parser.add_argument("--model", type=Path, default=SHIPPED / "spot.pt")
    parser.add_argument("--mesh", type=Path, default=SHIPPED / "spot.obj")
    args = parser.parse_args()
    network, mesh = load_model(args.model), read_mesh(args.mesh, drop_flat_faces=True)
    bins = len(mesh.positions) * args.rings * args.sectors
    print(f"{'error':>7}{'seed':>6}{'per bin':>8}{'passes':>8}{'total':>8}{'95 %':>8}{'seconds':>9}")
    for error in args.errors:
        for seed in range(args.seeds):
            began = time.perf_counter()
            bins_of_view = {"rings": args.rings, "sectors": args.sectors}
            provenance = bake(network, mesh, **bins_of_view, error=error, seed=seed).provenance
            estimated = provenance["estimated_relative_rmse"]
            print(
                f"{error:7.1%}{seed:6}{provenance['evaluations'] / bins:8.1f}{provenance['refinement']['passes']:8}"
                f"{estimated['total']:8.2%}{estimated['percentile_95_over_vertices']:8.2%}"
                f"{time.perf_counter() - began:9.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
