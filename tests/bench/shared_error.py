"""How much of the error of networks of one scene is the same in all of them, however they were trained.

    python -m tests.bench.shared_error SCENE.toml FIRST.pt SECOND.pt [MORE.pt ...] [--walks 2048]

Relative RMSE of a_lm over the surface and over vertices and views, the reference's noise taken out: of each network,
of their mean, and what each two of them share, √(Σ e₁·e₂ / Σ|a|²). A mean of ever more such networks would
still have that. The rest is chance: the noise of the walks, the order of the queries, where learning began.
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
    """√(Σ e₁·e₂ / Σ|a|²) of the errors of two answers [N,K,3] in percent (their relative RMSE where they are one), and
    its standard error over resampled queries.
    """
    noise = (truth.standard_error**2).sum(axis=(1, 2))
    product = ((first - truth.mean) * (second - truth.mean)).sum(axis=(1, 2)) - noise
    square = (truth.mean**2).sum(axis=(1, 2)) - noise
    chosen = np.random.default_rng(SEED).integers(len(noise), size=(RESAMPLES, len(noise)))
    again = product[chosen].sum(axis=1) / square[chosen].sum(axis=1)
    found = 100.0 * np.sqrt(np.maximum([product.sum() / square.sum(), *again], 0.0))
    return float(found[0]), float(found[1:].std())


def main() -> None:
    """Print the errors of each network, of their mean, and of each two."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--walks", type=int, default=2048)
    asked = parser.parse_args()
    scene = read_scene(asked.scene)
    networks = [load_model(path).on(scene.mesh) for path in asked.models]
    for place, truth in references(scene, asked.walks).items():
        answers = [network_coefficients(each, truth.positions, truth.outgoing, DIRECTIONS) for each in networks]
        for i, j in combinations_with_replacement(range(len(answers)), 2):
            value, error = shared(answers[i], answers[j], truth)
            names = asked.models[i].stem if i == j else f"{asked.models[i].stem} and {asked.models[j].stem}, shared"
            print(f"{place:10}{names:50}{value:7.2f} ± {error:.2f} %", flush=True)
        value, error = shared(*2 * [np.mean(answers, axis=0)], truth)
        print(f"{place:10}{'their mean':50}{value:7.2f} ± {error:.2f} %", flush=True)


if __name__ == "__main__":
    main()
