"""Walks on a GPU beside those on the processor: speed, the same walks, and z-tests of coefficients."""

import time
from pathlib import Path

import numba
import numpy as np
from numba import cuda

import prt_bake as prt
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.gpu.exits import Exits, new_exits, on_gpu
from prt_bake.tracer.light_samples import Exits as ProcessorExits
from prt_bake.tracer.prepared import KernelQueries, PreparedScene, prepare
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.rows import trace_exits

ROOT = Path(__file__).parents[2]
SCENES = {
    "grape": "scenes/grape/grape.toml",
    "dragon's stand-in": "scenes/dragon/serpent.toml",
    "lucy's stand-in": "scenes/lucy/figure.toml",
    "paperweight's stand-in": "scenes/paperweight/cow.toml",
    "drink": "scenes/drink/drink.toml",
    "spot": "prt_bake/shipped/spot.toml",
    "spot, matched": "scenes/matched/spot.toml",
    "grape, compensated": "scenes/grape/grape_compensated.toml",
    "cow, rough": "scenes/paperweight/cow_rough.toml",
    "head": "scenes/head/head.toml",
}
_SAME = 1e-3


def load(name: str) -> prt.Scene:
    """A scene by its name in SCENES."""
    return prt.load_scene(ROOT / SCENES[name])


def on_card(prepared: PreparedScene, queries: int, paths: int, seed: int, launch: object = None) -> Exits:
    """Exits on the GPU of the first queries of a scene, as arrays on the GPU."""
    source = QuerySource(prepared, 1, seed, 0.5)
    placed = source.for_kernel(source.draw(0, queries))
    arrays = KernelQueries._make(cuda.to_device(np.ascontiguousarray(field)) for field in placed)
    exits, first = new_exits(queries, paths), cuda.to_device(np.zeros(queries, np.int64))
    on_gpu(prepared).draw(arrays, first, seed, exits)
    cuda.synchronize()
    return exits


def walks_per_second(scene: prt.Scene, queries: int = 1 << 15, paths: int = 64) -> float:
    """Walks per second on the GPU: the median of three."""
    prepared = prepare(scene)
    source = QuerySource(prepared, 1, 0, 0.5)
    placed = source.for_kernel(source.draw(0, queries))
    arrays = KernelQueries._make(cuda.to_device(np.ascontiguousarray(field)) for field in placed)
    exits, first = new_exits(queries, paths), cuda.to_device(np.zeros(queries, np.int64))
    seconds = []
    for seed in range(4):
        cuda.synchronize()
        begun = time.perf_counter()
        on_gpu(prepared).draw(arrays, first, seed, exits)
        cuda.synchronize()
        seconds.append(time.perf_counter() - begun)
    return queries * paths / float(np.median(seconds[1:]))


def core_walks_per_second(scene: prt.Scene, queries: int = 512, paths: int = 64) -> float:
    """Walks per second on one core of the processor: the median of three."""
    prepared = prepare(scene)
    source = QuerySource(prepared, 1, 0, 0.5)
    chosen = source.draw(0, queries)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    trace_exits(prepared, source, source.draw(0, 1), 1, 0)
    seconds = []
    for seed in range(3):
        begun = time.perf_counter()
        trace_exits(prepared, source, chosen, paths, seed)
        seconds.append(time.perf_counter() - begun)
    numba.set_num_threads(threads)
    return queries * paths / float(np.median(seconds))


def different_walks(scene: prt.Scene, queries: int = 2048, paths: int = 16) -> tuple[float, float, float]:
    """Share of walks that differ between GPU and processor, and the mean throughputs of both."""
    prepared = prepare(scene)
    source = QuerySource(prepared, 1, 3, 0.5)
    here: ProcessorExits = trace_exits(prepared, source, source.draw(0, queries), paths, 3)
    there = on_card(prepared, queries, paths, 3)
    throughput, directions = there.throughput.copy_to_host(), there.directions.copy_to_host()
    apart = np.abs(throughput - here.throughput).max(axis=-1)
    lit = here.throughput.max(axis=-1) > 0.0
    apart = np.maximum(apart, np.where(lit, np.abs(directions - here.directions).max(axis=-1), 0.0))
    return float(np.mean(apart > _SAME)), float(throughput.mean()), float(here.throughput.mean())


def z_scores(scene: prt.Scene, queries: int = 128, paths: int = 4096) -> tuple[float, float]:
    """Mean square and largest of the z-scores of coefficients, GPU against processor, with independent walks."""
    source = QuerySource(prepare(scene), 1, 5, 0.5)
    chosen = source.draw(0, queries)
    x, eye = chosen.location.positions, chosen.outgoing
    here = estimate_coefficients(scene, x, eye, 2, paths, 11)
    there = estimate_coefficients(scene, x, eye, 2, paths, 12, device="cuda")
    z = (here.mean - there.mean) / np.sqrt(here.standard_error**2 + there.standard_error**2 + 1e-300)
    z = z[(here.standard_error > 0.0) & here.reliable[:, None, None]]
    return float(np.mean(z**2)), float(np.abs(z).max())
