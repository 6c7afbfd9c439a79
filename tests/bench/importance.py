"""What a lobe buys: KL divergence and variance of the one-sample estimator, by its shape, its axis and their number.

    python -m tests.bench.importance [MODEL.pt MESH] [--steps N] [--blocks N]

One uniform sky; `variance` is that of one sample relative to the square of its mean, averaged over queries that were
not learnt from. `CPU s` is the fit alone, `ns` the draw and the density of one direction. All lobes have a uniform
share of 10 %. The last lines draw from the fitted default and the paper's and evaluate the network there, which must
find the variance that the bins gave.
"""

import argparse
import math
import time
from dataclasses import replace

import numpy as np
import torch

from formats.mesh import read_mesh
from prt_bake.importance.fit import descend, gather
from prt_bake.importance.loss import TargetTensors, assess, assess_constant, uniform_fitness
from prt_bake.importance.module import IMPORTANCE_PRESETS, ImportanceModule, ImportanceSettings
from prt_bake.importance.targets import LUMINANCE
from prt_bake.network.bssrdf import NeuralBSSRDF, load_model

MEASURED, PAPER = IMPORTANCE_PRESETS["measured"], IMPORTANCE_PRESETS["paper"]
SHAPES = (1.0, 1.5, 2.0, 3.0, 4.0)
DRAWS = 64
ROW = "{:34}{:>9}{:>10}{:>8}{:>7}"


def cases() -> dict[str, ImportanceSettings]:
    found = {"paper: about the normal, β 2": PAPER}
    for shape in SHAPES:
        found[f"about the normal, β {shape:g}"] = replace(MEASURED, tilted=False, shape=shape)
    for lobes in (2, 3):
        found[f"{lobes} about the normal, β 2"] = replace(MEASURED, tilted=False, shape=2.0, lobes=lobes)
    for shape in SHAPES:
        found[f"axis of its own, β {shape:g}"] = replace(MEASURED, shape=shape)
    for lobes in (2, 3):
        for shape in (2.0, 3.0):
            found[f"{lobes} with axes of their own, β {shape:g}"] = replace(MEASURED, shape=shape, lobes=lobes)
    return found


def nanoseconds(module: ImportanceModule, held: TargetTensors) -> float:
    lobe = module.lobe(held.positions.numpy(), held.outgoing.numpy(), held.normals.numpy())
    numbers = np.random.default_rng(1).random((len(held), DRAWS, 3))
    times = []
    for _ in range(3):
        began = time.process_time()
        lobe.density(lobe.draw(numbers))
        times.append(time.process_time() - began)
    return 1e9 * min(times) / (len(held) * DRAWS)


def drawn_variance(module: ImportanceModule, network: NeuralBSSRDF, held: TargetTensors) -> float:
    """Relative variance of f over density, from draws, the square of the mean from the bins' sums of the network."""
    x, eye, normals = held.positions.numpy(), held.outgoing.numpy(), held.normals.double().numpy()
    lobe = module.lobe(x, eye, normals)
    directions = lobe.draw(np.random.default_rng(2).random((len(x), DRAWS, 3)))
    weights = np.maximum(network.evaluate(directions, x, eye) @ LUMINANCE, 0.0) / lobe.density(directions)
    grids = held.directions.double().numpy()
    fused = network.prepared()
    values = fused.evaluate_block(grids[:8], (held.turn.numpy() % 8)[:, None], x, eye[:, None])[:, 0]
    mean = 4.0 * math.pi * np.maximum(values @ LUMINANCE, 0.0).mean(axis=1)
    return float(((weights / mean[:, None] - 1.0) ** 2).mean())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("model", nargs="?", default="prt_bake/shipped/spot.pt")
    parser.add_argument("mesh", nargs="?", default="prt_bake/shipped/spot.obj")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--blocks", type=int, default=16)
    args = parser.parse_args()
    torch.set_num_threads(1)
    network, mesh = load_model(args.model), read_mesh(args.mesh)
    began = time.process_time()
    held, taught = gather(network.prepared(), mesh, args.blocks, seed=0)
    print(f"{len(held) + len(taught)} queries of 2048 directions: {time.process_time() - began:.1f} CPU s")
    print(ROW.format("", "KL", "variance", "CPU s", "ns"))
    uniform = uniform_fitness(held)
    print(ROW.format("uniform", f"{uniform.divergence:.4f}", f"{uniform.variance:.4f}", "", ""))
    for shape in SHAPES:
        fits = {sigma: assess_constant(sigma, shape, 0.1, held) for sigma in np.geomspace(0.4, 2.0, 17).round(3)}
        best = min(fits, key=lambda sigma: fits[sigma].divergence)
        name = f"constant σ = {best:g}, β {shape:g}"
        print(ROW.format(name, f"{fits[best].divergence:.4f}", f"{fits[best].variance:.4f}", "", ""), flush=True)
    fitted = {}
    for name, settings in cases().items():
        low, high = np.asarray(mesh.bounds)
        module = ImportanceModule(settings, low, float((high - low).max()))
        began = time.process_time()
        descend(module, taught, args.steps, seed=0)
        spent, fit = time.process_time() - began, assess(module, held)
        fitted[name] = module, fit
        cost = nanoseconds(module, held)
        figures = (f"{fit.divergence:.4f}", f"{fit.variance:.4f}", f"{spent:.1f}", f"{cost:.0f}")
        print(ROW.format(name, *figures), flush=True)
    for name in ("paper: about the normal, β 2", f"axis of its own, β {MEASURED.shape:g}"):
        module, fit = fitted[name]
        print(f"{name}: variance {fit.variance:.4f} by bins, {drawn_variance(module, network, held):.4f} by draws")


if __name__ == "__main__":
    main()
