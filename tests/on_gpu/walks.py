"""Walks on a GPU beside those on the processor: speed, the same walks, a furnace, and z-tests of coefficients."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np

from formats.scene import Scene, read_scene
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.gpu.device_functions import cuda
from prt_bake.tracer.gpu.exits import Exits, new_exits, on_gpu
from prt_bake.tracer.prepared import KernelQueries, PreparedScene, prepare
from prt_bake.trainer.samples.queries import Queries, QuerySource
from prt_bake.trainer.samples.rows import trace_exits

ROOT = Path(__file__).parents[2]
SCENES = {
    "grape": "scenes/grape/grape.toml",
    "dragon's stand-in": "scenes/dragon/serpent.toml",
    "lucy's stand-in": "scenes/lucy/figure.toml",
    "paperweight's stand-in": "scenes/paperweight/cow.toml",
    "drink": "scenes/drink/drink.toml",
    "spot": "prt_bake/shipped/spot.toml",
    "spot, index-matched": "scenes/matched/spot.toml",
    "grape, compensated": "scenes/grape/grape_compensated.toml",
    "cow, rough": "scenes/paperweight/cow_rough.toml",
    "head": "scenes/head/head.toml",
}
_SAME = 1e-3


def load(name: str) -> Scene:
    """A scene by its name in SCENES."""
    return read_scene(ROOT / SCENES[name])


def drawn(prepared: PreparedScene, queries: int, seed: int) -> tuple[QuerySource, Queries]:
    """Queries as in trainings, half of them uniform over the faces."""
    source = QuerySource(prepared, 1, seed, 0.5)
    return source, source.draw(0, queries)


def launcher(prepared: PreparedScene, queries: int, paths: int) -> tuple[Callable[[int], None], Exits]:
    """A function that walks on the GPU with a seed and waits for it, and the exits that it fills."""
    source, chosen = drawn(prepared, queries, 3)
    arrays = KernelQueries._make(map(cuda.to_device, source.for_kernel(chosen)))
    exits, first = new_exits(queries, paths), cuda.to_device(np.zeros(queries, np.int64))

    def launch(seed: int) -> None:
        on_gpu(prepared).draw(arrays, first, seed, exits)
        cuda.synchronize()

    return launch, exits


def median_seconds(call: Callable[[int], None]) -> float:
    """Of three calls, after one that compiles."""
    seconds = []
    for seed in range(4):
        begun = time.perf_counter()
        call(seed)
        seconds.append(time.perf_counter() - begun)
    return float(np.median(seconds[1:]))


def walks_per_second(scene: Scene, queries: int = 1 << 15, paths: int = 64) -> float:
    """Walks per second on the GPU."""
    return queries * paths / median_seconds(launcher(prepare(scene), queries, paths)[0])


def core_walks_per_second(scene: Scene, queries: int = 256, paths: int = 64) -> float:
    """Walks per second on one core of the processor."""
    prepared = prepare(scene)
    source, chosen = drawn(prepared, queries, 3)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        seconds = median_seconds(lambda seed: (trace_exits(prepared, source, chosen, paths, seed), None)[1])
    finally:
        numba.set_num_threads(threads)
    return queries * paths / seconds


def different_walks(scene: Scene, queries: int = 2048, paths: int = 16) -> tuple[float, float]:
    """Share of walks that differ between GPU and processor, and the relative difference of the mean throughput."""
    prepared = prepare(scene)
    source, chosen = drawn(prepared, queries, 3)
    here = trace_exits(prepared, source, chosen, paths, 3)
    launch, there = launcher(prepared, queries, paths)
    launch(3)
    throughput, directions = there.throughput.copy_to_host(), there.directions.copy_to_host()
    lit = here.throughput.max(axis=-1) > 0.0
    apart = np.abs(throughput - here.throughput).max(axis=-1)
    apart = np.maximum(apart, np.where(lit, np.abs(directions - here.directions).max(axis=-1), 0.0))
    return float(np.mean(apart > _SAME)), float(throughput.mean(dtype=np.float64) / here.throughput.mean() - 1.0)


def furnace(scene: Scene, queries: int = 4096, paths: int = 64) -> float:
    """Largest deviation from 1 of the throughput of walks that leave a white, index-matched object."""
    medium = scene.parts[0].medium
    assert medium is not None
    white = replace(scene.parts[0], eta=1.0, medium=replace(medium, albedo=np.ones(3)))
    launch, exits = launcher(prepare(replace(scene, parts=(white,))), queries, paths)
    launch(1)
    return float(np.abs(exits.throughput.copy_to_host() - 1.0).max())


def z_scores(scene: Scene, queries: int = 128, paths: int = 4096) -> tuple[float, float, int]:
    """Mean square, largest and number of the z-scores of coefficients, GPU against processor, independent walks."""
    _source, chosen = drawn(prepare(scene), queries, 5)
    x, eye = chosen.location.positions, chosen.outgoing
    here = estimate_coefficients(scene, x, eye, 2, paths, 11)
    there = estimate_coefficients(scene, x, eye, 2, paths, 12, device="cuda")
    variance = here.standard_error**2 + there.standard_error**2
    known = (variance > 0.0) & (here.reliable & there.reliable)[:, None, None]
    z = ((here.mean - there.mean)[known]) / np.sqrt(variance[known])
    return float(np.mean(z**2)), float(np.abs(z).max()), len(z)
