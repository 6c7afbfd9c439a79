"""Variance and cost of one walk as an estimate of coefficients: exits compared with connections.

    python -m tests.bench.noise_of_a_walk [SCENE.toml ...] [--queries 300]

For each kind of ray: CPU microseconds per walk, the relative variance v of the degree-2 coefficients from one walk (for
connections to D directions only the noise of the walk, not that of the directions), and their product, which is
proportional to the time to a given error. Training uses the rays with the least product
(`prt_bake.trainer.samples.rows`).
"""

import argparse
import time
from pathlib import Path

import numpy as np

from formats.scene import read_scene
from prt_bake.mathematics import sh
from prt_bake.shipped.demonstration import SHIPPED
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.prepared import PreparedScene, prepare, smooth_part
from prt_bake.trainer.samples.queries import Queries, QuerySource
from prt_bake.trainer.samples.rows import trace_exits, trace_values

CONNECTIONS = [(1, 1), (2, 2), (4, 2), (4, 4), (8, 1), (8, 2), (8, 4), (8, 8), (16, 8)]
WALKS, ROUNDS, EACH = 192, 8, 4


def exits(prepared: PreparedScene, count: int, size: float) -> tuple[float, float]:
    """CPU seconds per walk and v of exits; `size` is Σ|a|²."""
    source = QuerySource(prepared, 1, 1)
    queries = source.draw(0, count)
    trace_exits(prepared, source, queries, 2, 2)
    begun = time.process_time()
    found = trace_exits(prepared, source, queries, WALKS, 3)
    seconds = (time.process_time() - begun) / (count * WALKS)
    throughput = np.where(found.unscattered[..., None], 0.0, found.throughput)
    basis = sh.evaluate(found.directions.reshape(-1, 3), 2).reshape(count, WALKS, 9)
    mean = np.einsum("npk,npc->nkc", basis, throughput) / WALKS
    square = np.einsum("npk,npc->nkc", basis**2, throughput**2) / WALKS
    return seconds, float(np.sum(square - mean**2) * WALKS / (WALKS - 1) / size)


def connections(prepared: PreparedScene, count: int, size: float, directions: int, taken: int) -> tuple[float, float]:
    """CPU seconds per walk and v of connections to `taken` of D directions at each event."""
    source = QuerySource(prepared, directions, 1)
    queries: Queries = source.draw(0, count)
    basis = sh.evaluate(queries.incident.reshape(-1, 3), 2).reshape(count, directions, 9)
    mean, _ = trace_values(prepared, source, queries, WALKS, taken, 2)
    seconds, square = 0.0, 0.0
    for number in range(ROUNDS):
        begun = time.process_time()
        some, _ = trace_values(prepared, source, queries, EACH, taken, 10 + number)
        seconds += time.process_time() - begun
        noise = 4.0 * np.pi / directions * np.einsum("ndc,ndk->nkc", some - mean, basis)
        square += EACH * float(np.sum(noise**2))
    # The subtracted mean is noisy too.
    return seconds / (ROUNDS * EACH * count), square / (ROUNDS * (1.0 + EACH / WALKS)) / size


def main() -> None:
    """Print a table for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path, default=[SHIPPED / "spot.toml"])
    parser.add_argument("--queries", type=int, default=300)
    args = parser.parse_args()
    for path in args.scenes:
        scene = read_scene(path)
        prepared = prepare(scene)
        queries = QuerySource(prepared, 1, 1).draw(0, args.queries)
        truth = estimate_coefficients(scene, queries.location.positions, queries.outgoing, 2, 2048, 5)
        size = float(np.sum(truth.mean**2) - np.sum(truth.standard_error**2))
        print(f"{path}\n{'rays':28}{'µs/walk':>10}{'v':>8}{'µs · v':>9}")
        rows = [("exits", exits(prepared, args.queries, size))]
        if smooth_part(scene) is None:
            for d, c in CONNECTIONS:
                rows.append((f"{d} directions, {c} per event", connections(prepared, args.queries, size, d, c)))
        for name, (seconds, v) in rows:
            print(f"{name:28}{1e6 * seconds:10.1f}{v:8.2f}{1e6 * seconds * v:9.1f}", flush=True)


if __name__ == "__main__":
    main()
