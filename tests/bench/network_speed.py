"""Speed of the network in a bake: evaluations of Ŝ per second and core, and the share of the matrix units' peak.

    python tests/bench/network_speed.py

The peak is what the same fused linear operator reaches on the first layer's shape alone, rows in cache.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from prt_bake import sphere
from prt_bake.network import PRESETS, NeuralBSSRDF
from prt_bake.neural.fused import PRECISIONS, FusedNetwork
from prt_bake.neural.interior import LEVELS, REACH, Interior

VERTICES, BINS, DIRECTIONS, COPIES = 4, 1024, 64, 256
REPEATS = 5


def best_time(work: Callable[[], object]) -> float:
    work()
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def peak(fused: FusedNetwork, precision: str) -> float:
    """FLOP/s of the first layer alone."""
    weight, bias = fused._weights[0], fused._biases[0]
    rows = torch.rand(2048, weight.shape[1]).to(PRECISIONS[precision])
    with torch.inference_mode():
        seconds = best_time(lambda: [fused._linear(rows, weight, bias, "relu") for _ in range(20)])
    return 20 * 2 * len(rows) * weight.numel() / seconds


def ball(places: int) -> Interior:
    """The inside of a ball that fills the box, with an interface."""
    spacing = 1.1 / (places - 1)
    x, y, z = np.meshgrid(*[np.linspace(-0.55, 0.55, places)] * 3, indexing="ij")
    levels = np.clip((0.5 - np.sqrt(x * x + y * y + z * z)) / (REACH * spacing), -1.0, 1.0)
    return Interior(np.rint(LEVELS * levels[None]).astype(np.int8), (-0.05, -0.05, -0.05), spacing, (5.0,), 1.3)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    torch.set_num_threads(1)
    incident = sphere.uniform(COPIES * DIRECTIONS, 1).reshape(COPIES, DIRECTIONS, 3)
    outgoing = sphere.uniform(VERTICES * BINS, 2).reshape(VERTICES, BINS, 3)
    positions = np.random.default_rng(3).uniform(size=(VERTICES, 3))
    rotation = np.random.default_rng(4).integers(0, COPIES, (VERTICES, BINS))
    evaluations = VERTICES * BINS * DIRECTIONS
    print(f"{'preset':10}{'precision':11}{'evaluations/s':>15}{'GFLOP/s':>9}{'peak':>7}{'share':>7}")
    measured = PRESETS["measured"]
    less = {"no lobes": replace(measured, lobes=0), "no shape": replace(measured, lobes=0, shape_places=0)}
    for preset, settings in {**PRESETS, **less}.items():
        network = NeuralBSSRDF(settings, interior=ball(64) if settings.ray_samples else None)
        work = 2 * sum(outputs * inputs for outputs, inputs in settings.layer_shapes)
        for precision in PRECISIONS:
            fused = network.prepared(precision)
            block = (incident, rotation, positions, outgoing)
            rate = evaluations / best_time(lambda f=fused, b=block: f.evaluate_block(*b))  # type: ignore[misc]
            speed, top = rate * work, peak(fused, precision)
            print(f"{preset:10}{precision:11}{rate:15,.0f}{speed / 1e9:9.0f}{top / 1e9:7.0f}{speed / top:7.0%}")


if __name__ == "__main__":
    main()
