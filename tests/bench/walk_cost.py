"""Cost of a query on one thread as the medium grows thick or heterogeneous: seconds, and efficiency over the first row.

    python -m tests.bench.walk_cost [--queries 5]

Measures Ŝ of a sphere of diameter 1 with an index-matched boundary, lit from the visible side. `seconds` is the CPU
time to an error of 1 % and `paths/s` the rate of a query, both geometric means over queries. `events` is the number of
scatterings per path: if dense voxels scatter it grows with the contrast, whatever the tracking method; if they absorb
(albedo 0) the remaining time is that of tracking through them.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numba
import numpy as np

from formats.scene import Scene
from prt_bake.tracer.kernels import draw_exits
from prt_bake.tracer.prepared import prepare
from tests.bench.efficiency import ours, paths_for, timed
from tests.tracer.scenes import make_scene, moved, queries, sphere, unit_directions

THICKNESS = (1.0, 10.0, 100.0, 1000.0, 10_000.0)
CONTRAST = (1.0, 10.0, 100.0, 1000.0, 10_000.0)
DENSE_SHARE = 0.01
ERROR = 0.01
SECONDS = 0.1
PATHS_COUNTED = 300
GRIDS = (16, 64)


def cost(count: int, **keys: Any) -> tuple[float, float, float]:
    """Paths/s of a query, seconds to a relative error of ERROR, and scatterings per path."""
    with tempfile.TemporaryDirectory() as folder:
        scene = make_scene(Path(folder), moved(sphere(4), 0.5), **keys)
    positions, outgoing, normals = queries(scene.mesh, count, 1)
    incident = unit_directions(count, 2)
    incident *= np.sign(np.sum(incident * normals, axis=1, keepdims=True))
    queried = [ours(scene, positions[n], outgoing[n], incident[n : n + 1]) for n in range(count)]
    paths = paths_for(queried[0], SECONDS)
    runs = [timed(batches, paths, n) for n, batches in enumerate(queried)]
    seconds = np.array([run.seconds for run in runs])
    noise = np.array([run.variance[0] / run.mean[0] ** 2 for run in runs])
    rate, spent = float(np.exp(-np.log(seconds).mean())), float(np.exp(np.log(noise * seconds).mean())) / ERROR**2
    return rate, spent, scatterings(scene, positions, outgoing)


def scatterings(scene: Scene, positions: np.ndarray, outgoing: np.ndarray) -> float:
    """Scatterings per path, over walks that leave and walks that end inside."""
    prepared = prepare(scene)
    shape = (len(positions), PATHS_COUNTED)
    scattered = np.zeros(shape, np.int64)
    placed = prepared.place(positions, outgoing, np.arange(len(positions), dtype=np.uint64))
    directions, throughput = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    exits = directions, throughput, scattered
    draw_exits(0, len(positions), prepared.boundary, prepared.medium, placed, PATHS_COUNTED, 1, *exits)
    return float(scattered.mean())


def heterogeneous(size: int, contrast: float, dense_albedo: float) -> dict[str, np.ndarray]:
    """Extinction 5 and albedo 0.99, with one voxel in a hundred denser by the contrast."""
    dense = np.random.default_rng(5).random((size,) * 3) < DENSE_SHARE
    return {"sigma_t": np.where(dense, 5.0 * contrast, 5.0), "albedo": np.where(dense, dense_albedo, 0.99)}


def table(title: str, rows: dict[str, dict[str, Any]], count: int) -> None:
    """Print a row for each medium."""
    print(f"\n{title:24}{'paths/s':>12}{'seconds to 1 %':>16}{'efficiency':>12}{'events':>10}")
    first = None
    for name, keys in rows.items():
        rate, seconds, events = cost(count, **keys)
        first = first or seconds
        print(f"{name:24}{rate:12,.0f}{seconds:16.3g}{first / seconds:12.3g}{events:10.3g}", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--queries", type=int, default=5)
    count = parser.parse_args().queries
    numba.set_num_threads(1)
    for albedo in (1.0, 0.999):
        rows = {f"{sigma_t:g}": {"sigma_t": sigma_t, "albedo": albedo} for sigma_t in THICKNESS}
        table(f"thickness, albedo {albedo:g}", rows, count)
    for size in GRIDS:
        for name, albedo in (("absorb", 0.0), ("scatter", 0.99)):
            rows = {f"{contrast:g}": heterogeneous(size, contrast, albedo) for contrast in CONTRAST}
            table(f"contrast {size}³, {name}", rows, count)


if __name__ == "__main__":
    main()
