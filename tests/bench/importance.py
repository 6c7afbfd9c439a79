"""Importance sampling by lobes: KL divergence and one-sample variance by the lobes' shape, axis and number.

    python -m tests.bench.importance [MODEL.pt MESH] [--steps N] [--blocks N]

Under a uniform sky, `variance` is that of one sample over the square of its mean, averaged over held-out queries.
`CPU s` is the time of the fit, `ns` the time to draw one direction and its density. All lobes have a uniform share of
10 %. The last lines draw from the fitted default and from the paper's module and evaluate the network there; the
variances must agree with those from the bins.
"""

import argparse
import math
import time
from dataclasses import replace

import numpy as np
import torch

from formats.image.gamut import LUMINANCE
from formats.mesh import read_mesh
from prt_bake.importance.fit import descend, gather
from prt_bake.importance.loss import TargetTensors, assess, assess_constant, uniform_fitness
from prt_bake.importance.module import IMPORTANCE_PRESETS, ImportanceModule, ImportanceSettings
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
        found[f"free axis, β {shape:g}"] = replace(MEASURED, shape=shape)
    for lobes in (2, 3):
        for shape in (2.0, 3.0):
            found[f"{lobes} with free axes, β {shape:g}"] = replace(MEASURED, shape=shape, lobes=lobes)
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
    """Relative variance of f over the density from draws, with the mean from the network's values in the bins."""
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default="prt_bake/shipped/spot.pt")
    parser.add_argument("mesh", nargs="?", default="prt_bake/shipped/spot.obj")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--blocks", type=int, default=16)
    args = parser.parse_args()
    torch.set_num_threads(1)
    mesh = read_mesh(args.mesh)
    network = load_model(args.model, mesh=mesh)
    began = time.process_time()
    held_out, training = gather(network.prepared(), mesh, args.blocks, seed=0)
    print(f"{len(held_out) + len(training)} queries of 2048 directions: {time.process_time() - began:.1f} CPU s")
    print(ROW.format("", "KL", "variance", "CPU s", "ns"))
    uniform = uniform_fitness(held_out)
    print(ROW.format("uniform", f"{uniform.divergence:.4f}", f"{uniform.variance:.4f}", "", ""))
    for shape in SHAPES:
        fits = {sigma: assess_constant(sigma, shape, 0.1, held_out) for sigma in np.geomspace(0.4, 2.0, 17).round(3)}
        best = min(fits, key=lambda sigma: fits[sigma].divergence)
        name = f"constant σ = {best:g}, β {shape:g}"
        print(ROW.format(name, f"{fits[best].divergence:.4f}", f"{fits[best].variance:.4f}", "", ""), flush=True)
    fitted = {}
    for name, settings in cases().items():
        low, high = np.asarray(mesh.bounds)
        module = ImportanceModule(settings, low, float((high - low).max()))
        began = time.process_time()
        descend(module, training, args.steps, seed=0)
        spent, fit = time.process_time() - began, assess(module, held_out)
        fitted[name] = module, fit
        cost = nanoseconds(module, held_out)
        figures = (f"{fit.divergence:.4f}", f"{fit.variance:.4f}", f"{spent:.1f}", f"{cost:.0f}")
        print(ROW.format(name, *figures), flush=True)
    for name in ("paper: about the normal, β 2", f"free axis, β {MEASURED.shape:g}"):
        module, fit = fitted[name]
        print(f"{name}: variance {fit.variance:.4f} by bins, {drawn_variance(module, network, held_out):.4f} by draws")


if __name__ == "__main__":
    main()
