"""Speed of the network in a bake: evaluations of Ŝ per second and core, and its share of a matrix product's speed.

    python -m tests.bench.network_speed
    python -m tests.bench.network_speed --device cuda

`product` is the speed of a product of 2048 × 2048 matrices of the same type on the same core (512 × 512 if that would
take half a minute), by the faster of two operators; on a GPU of 8192 × 8192 matrices. `useful` counts the FLOP of the
layers as in the settings, without sines, cosines and padding. `done` counts them with layers that do not depend on ωi
evaluated once for all 64 directions of a bin. `error` is the relative RMS difference from the plain float32 CPU path.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from formats.errors import InputWarning
from prt_bake.baking.sources import require_device
from prt_bake.mathematics import sphere
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.inference.fused import PRECISIONS, FusedNetwork
from prt_bake.network.inference.linear import onednn_linear, onednn_works
from prt_bake.network.low_bands import low_shapes

BINS, DIRECTIONS, COPIES = 1024, 64, 256
VERTICES = {"cpu": 4, "cuda": 64}
REPEATS = 5
LONGEST = 30.0
SMALL, LARGE, ON_GPU = 512, 2048, 8192
COMPARED = 32
"""Bins whose values are compared."""


def best_time(work: Callable[[], object]) -> float:
    """Seconds of the fastest repetition; slow work is repeated less, since processors may emulate bfloat16."""
    times: list[float] = []
    while len(times) <= REPEATS and sum(times) < LONGEST:
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def peak(precision: str, device: str) -> float:
    """FLOP/s of a large matrix product, or of a small one if a large one would take too long."""
    if device != "cpu":
        return product_rate(precision, ON_GPU, device)
    rate = product_rate(precision, SMALL)
    return product_rate(precision, LARGE) if 2 * LARGE**3 / rate < LONGEST else rate


def product_rate(precision: str, side: int, device: str = "cpu") -> float:
    one, other = torch.rand(2, side, side, device=device).to(PRECISIONS[precision])
    none = torch.zeros(side, dtype=one.dtype, device=device)
    # GPUs work asynchronously: reading one number of the result waits for it.
    operators = [lambda: torch.mm(one, other)[0, 0].cpu(), lambda: onednn_linear(one, other, none, "none")]
    with torch.inference_mode():
        usable = operators if onednn_works(one) else operators[:1]
        return 2 * side**3 / min(best_time(operator) for operator in usable)


def difference(network: NeuralBSSRDF, fused: FusedNetwork, block: tuple[Any, ...]) -> float:
    """Relative RMS difference of some of a block's values from the plain float32 path."""
    incident, rotation, positions, outgoing = block
    some = np.linspace(0, rotation.size - 1, COMPARED).astype(np.int64)
    rotation, eye, x = rotation.reshape(-1)[some], outgoing.reshape(-1, 3)[some], positions[some // BINS]
    expected = network.evaluate(incident[rotation], x, eye)
    return float(
        np.linalg.norm(fused.evaluate_block(incident, rotation[:, None], x, eye[:, None])[:, 0] - expected)
    ) / float(np.linalg.norm(expected))


def flop(network: NeuralBSSRDF) -> tuple[float, float]:
    """FLOP of one evaluation: of all layers, and of those evaluated for each of DIRECTIONS directions of a bin."""
    settings = network.settings
    if network.only_low:
        shapes = low_shapes(settings.view_inputs, settings.low_width, settings.low_layers, len(settings.axis_columns))
        work = 2 * sum(outputs * inputs for outputs, inputs in shapes) / DIRECTIONS
        return work, work
    shapes = settings.layer_shapes
    useful = 2 * sum(outputs * inputs for outputs, inputs in shapes)
    if not settings.trunk:
        return useful, useful
    alone = settings.pair_inputs + settings.width * np.arange(settings.light_layers)
    late = sum(2 * settings.width * int(inputs) for inputs in alone) + 2 * 3 * settings.width
    once = sum(2 * outputs * inputs for outputs, inputs in shapes[: settings.trunk])
    return useful, late + once / DIRECTIONS


def ball(places: int) -> Interior:
    """The interior of a ball that fills the box, with an interface."""
    spacing = 1.1 / (places - 1)
    x, y, z = np.meshgrid(*[np.linspace(-0.55, 0.55, places)] * 3, indexing="ij")
    levels = np.clip((0.5 - np.sqrt(x * x + y * y + z * z)) / (REACH * spacing), -1.0, 1.0)
    return Interior(np.rint(LEVELS * levels[None]).astype(np.int8), (-0.05, -0.05, -0.05), spacing, (5.0,), 1.3)


def networks() -> dict[str, NeuralBSSRDF]:
    """The networks of the presets, with less, and as a bake to degree 2 evaluates the default one."""
    measured = PRESETS["measured"]
    less = {"no lobes": replace(measured, lobes=0), "no shape": replace(measured, lobes=0, shape_places=0)}
    made = {
        name: NeuralBSSRDF(settings, interior=ball(64) if settings.ray_samples else None)
        for name, settings in {**PRESETS, **less}.items()
    }
    return {**made, "low bands": made["measured"].up_to(2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    device = parser.parse_args().device
    require_device(device)
    warnings.simplefilter("ignore", InputWarning)  # without a mesh, normals are those of the grid
    torch.set_num_threads(1)
    incident = sphere.uniform(COPIES * DIRECTIONS, 1).reshape(COPIES, DIRECTIONS, 3)
    vertices = VERTICES[device]
    outgoing = sphere.uniform(vertices * BINS, 2).reshape(vertices, BINS, 3)
    positions = 0.5 + 0.5 * sphere.uniform(vertices, 3)
    rotation = np.random.default_rng(4).integers(0, COPIES, (vertices, BINS))
    evaluations = vertices * BINS * DIRECTIONS
    print(
        f"{'preset':10}{'precision':11}{'evaluations/s':>15}{'product':>9}{'useful':>8}{'share':>7}{'done':>8}{'share':>7}{'error':>9}"
    )
    for preset, network in networks().items():
        for precision in PRECISIONS:
            fused, top = network.prepared(precision, device), peak(precision, device)
            block = (incident, rotation, positions, outgoing)
            rate = evaluations / best_time(lambda f=fused, b=block: f.evaluate_block(*b))  # type: ignore[misc]
            shares = "".join(f"{rate * work / 1e9:8.0f}{rate * work / top:7.0%}" for work in flop(network))
            error = difference(network, fused, block)
            print(f"{preset:10}{precision:11}{rate:15,.0f}{top / 1e9:9.0f}{shares}{error:9.1e}", flush=True)


if __name__ == "__main__":
    main()
