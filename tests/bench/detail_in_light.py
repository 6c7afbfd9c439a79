"""Detail of Ŝ in the direction of incidence, degree by degree: path-traced and of a network.

    python -m tests.bench.detail_in_light [SCENE.toml MODEL.pt] [--vertices 150] [--walks 4096]

Prints, over vertices and views and in percent of Σ|a|² of degrees 0 to 2: the squares of the path-traced coefficients
of each degree (corrected for noise), those of the network, and the network's squared error. Then the error of a bake at
degree 2 from few directions, relative to the network's exact coefficients: detail beyond degree 2 aliases into them.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from formats.scene import read_scene
from prt_bake.geometry.surface import Surface
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci, random_rotations
from prt_bake.network.bssrdf import NeuralBSSRDF, load_model
from prt_bake.shipped.demonstration import SHIPPED
from prt_bake.tracer.estimate import estimate_coefficients

DEGREE = 10
FINE = 1024
"""Directions that resolve the whole sphere."""
FEW = (32, 64, 128, 256)
VIEWS = 2


def views(mesh: Mesh, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions and outgoing directions [count·VIEWS, 3] at random vertices, above their horizon."""
    generator = np.random.default_rng(seed)
    chosen = np.repeat(generator.choice(len(mesh.positions), min(count, len(mesh.positions)), replace=False), VIEWS)
    outgoing = generator.normal(size=(len(chosen), 3))
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    cosine = (outgoing * mesh.normals[chosen]).sum(axis=1, keepdims=True)
    outgoing -= 2.0 * np.minimum(cosine, 0.0) * mesh.normals[chosen]
    positions = mesh.positions[chosen]
    return positions, Surface(mesh).locate_clamped(positions, outgoing)[0]


def by_degree(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums [DEGREE + 1] of squares [K] over the coefficients of each degree."""
    return np.add.reduceat(squares, [degree**2 for degree in range(DEGREE + 1)])


def fitted(
    network: NeuralBSSRDF, directions: NDArray[np.float64], x: NDArray[np.float64], wo: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Degree-2 coefficients [N,9,3] by least squares."""
    values = network.evaluate(directions, x, wo).astype(np.float64)
    return np.einsum("kd,ndc->nkc", np.linalg.pinv(sh.evaluate(directions, 2)), values)


def main() -> None:
    """Print the table, then the errors of few directions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", type=Path, default=SHIPPED / "spot.toml")
    parser.add_argument("model", nargs="?", type=Path, default=SHIPPED / "spot.pt")
    parser.add_argument("--vertices", type=int, default=150)
    parser.add_argument("--walks", type=int, default=4096)
    args = parser.parse_args()
    scene = read_scene(args.scene)
    network = load_model(args.model).on(scene.mesh)
    x, wo = views(scene.mesh, args.vertices, 1)
    traced = estimate_coefficients(scene, x, wo, DEGREE, args.walks, 5)
    noise = traced.standard_error**2
    lattice = fibonacci(FINE)
    values = network.evaluate(lattice, x, wo).astype(np.float64)
    own = 4.0 * np.pi / FINE * np.einsum("dk,ndc->nkc", sh.evaluate(lattice, DEGREE), values)
    of_traced = by_degree((traced.mean**2 - noise).sum(axis=(0, 2)))
    total = of_traced[:3].sum()
    rows = (
        of_traced,
        by_degree((own**2).sum(axis=(0, 2))),
        by_degree(((own - traced.mean) ** 2 - noise).sum(axis=(0, 2))),
    )
    print(f"{'degree':>8}{'path-traced':>13}{'network':>9}{'error':>9}   (% of degrees 0 to 2)")
    for degree in range(DEGREE + 1):
        print(
            f"{degree:8}"
            + "".join(f"{100.0 * row[degree] / total:{width}.2f}" for row, width in zip(rows, (13, 9, 9), strict=True))
        )
    turns = random_rotations(8, 3)
    for count in FEW:
        misses = [((fitted(network, fibonacci(count) @ turn.T, x, wo) - own[:, :9]) ** 2).sum() for turn in turns]
        missed = np.sqrt(np.mean(misses) / (own[:, :9] ** 2).sum())
        print(f"degree 2 from {count:3} directions: {missed:.2%} from that of {FINE}")


if __name__ == "__main__":
    main()
