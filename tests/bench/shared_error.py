"""How much of their error networks of the same scene have in common.

    python -m tests.bench.shared_error SCENE.toml FIRST.pt SECOND.pt [MORE.pt ...] [--walks 2048]

Prints the relative RMSE of a_lm over the surface and over vertices and views, corrected for the reference's noise: of
each network, of their mean, and the error that each pair shares, √(Σ e₁·e₂ / Σ|a|²). The shared error remains in the
mean of any number of networks. The rest is random: the noise of the walks, the order of the queries, initial weights.
"""

import argparse
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene, read_scene
from prt_bake.network.bssrdf import load_model
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.report.evaluation import vertex_views
from prt_bake.trainer.validation import HeldOutCoefficients, hold_out_coefficients, network_coefficients

QUERIES, VERTICES, VIEWS, SEED = 1024, 256, 4, 0x5A4E
DIRECTIONS, RESAMPLES = 256, 200


def references(scene: Scene, walks: int) -> dict[str, HeldOutCoefficients]:
    """Path-traced coefficients over the surface, and over vertices and views."""
    x, wo = vertex_views(prepare(scene), VERTICES, VIEWS, SEED).flat()
    traced = estimate_coefficients(scene, x, wo, 2, walks, SEED + 2)
    return {
        "surface": hold_out_coefficients(scene, QUERIES, walks, SEED, DIRECTIONS),
        "vertices": HeldOutCoefficients(x, wo, traced.mean, traced.standard_error, DIRECTIONS),
    }


def shared(first: NDArray[np.float64], second: NDArray[np.float64], truth: HeldOutCoefficients) -> tuple[float, float]:
    """√(Σ e₁·e₂ / Σ|a|²) of the errors of two predictions [N,K,3] in percent, and its bootstrap standard error.

    It is the relative RMSE if both are the same.
    """
    noise = (truth.standard_error**2).sum(axis=(1, 2))
    product = ((first - truth.mean) * (second - truth.mean)).sum(axis=(1, 2)) - noise
    square = (truth.mean**2).sum(axis=(1, 2)) - noise
    chosen = np.random.default_rng(SEED).integers(len(noise), size=(RESAMPLES, len(noise)))
    resampled = product[chosen].sum(axis=1) / square[chosen].sum(axis=1)
    errors = 100.0 * np.sqrt(np.maximum([product.sum() / square.sum(), *resampled], 0.0))
    return float(errors[0]), float(errors[1:].std())


def main() -> None:
    """Print the errors of each network, of their mean, and of each pair."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--walks", type=int, default=2048)
    args = parser.parse_args()
    scene = read_scene(args.scene)
    networks = [load_model(path).on(scene.mesh) for path in args.models]
    for place, truth in references(scene, args.walks).items():
        predictions = [network_coefficients(each, truth.positions, truth.outgoing, DIRECTIONS) for each in networks]
        for i, j in combinations_with_replacement(range(len(predictions)), 2):
            value, error = shared(predictions[i], predictions[j], truth)
            names = args.models[i].stem if i == j else f"{args.models[i].stem} and {args.models[j].stem}, shared"
            print(f"{place:10}{names:50}{value:7.2f} ± {error:.2f} %", flush=True)
        value, error = shared(*2 * [np.mean(predictions, axis=0)], truth)
        print(f"{place:10}{'their mean':50}{value:7.2f} ± {error:.2f} %", flush=True)


if __name__ == "__main__":
    main()
