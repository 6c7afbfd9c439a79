"""What a network's correction of its values by its low bands gains, compared with path tracing.

    python -m tests.bench.corrected_values SCENE.toml MODEL.pt … [--queries 1000] [--paths 8192]

Relative RMSE in percent, the paths' noise taken out, at random points and views of the object: of a_lm to degree 4, and
of the radiance under each sky of the paper. Rows: the values without the correction; as they are; and with exactly the
low bands, which no correction exceeds. In Python `network.up_to(2)` is the last one to degree 2.
"""

import argparse
from copy import deepcopy
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import prt_bake as prt
from prt_bake.lights.lighting import as_lighting
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.samples.queries import Queries, QuerySource
from prt_bake.trainer.samples.rows import trace_exits
from tests import ROOT

Array = NDArray[np.float64]

SKIES = "outdoor", "indoor"
DEGREE, LOW = 4, 9
LATTICE = fibonacci(4096)
AT_ONCE = 50


class Lights:
    """Functions of ωi whose integrals with Ŝ are compared: the harmonics, and the radiance of each sky."""

    def __init__(self, up: str) -> None:
        files = (ROOT / "scenes" / "skies" / f"{name}.hdr" for name in SKIES)
        self._skies = [as_lighting(prt.read_lighting(str(file), up=up), up, 0.0) for file in files]

    def integrals(self, directions: Array, weighted: Array) -> list[Array]:
        """Σ_d of each function times `weighted` [n,D,3] in directions [n,D,3]: [n,K,3] and [n,1,3] for each sky."""
        flat = directions.reshape(-1, 3)
        harmonics = sh.evaluate(flat, DEGREE).reshape(*directions.shape[:2], -1)
        skies = [sky.radiance(flat).reshape(directions.shape) * weighted for sky in self._skies]
        return [np.einsum("ndk,ndc->nkc", harmonics, weighted), *(sky.sum(axis=1, keepdims=True) for sky in skies)]


def traced(scene: prt.Scene, queries: int, paths: int, lights: Lights) -> tuple[Queries, list[list[Array]]]:
    """Queries, and two independent path-traced estimates of their integrals."""
    prepared = prepare(scene)
    source = QuerySource(prepared, 1, 4242, 0.5)
    halves: list[list[list[Array]]] = [[], []]
    for first in range(0, queries, AT_ONCE):
        some = source.draw(first, min(AT_ONCE, queries - first))
        for seed, found in enumerate(halves):
            exits = trace_exits(prepared, source, some, paths // 2, seed)
            throughput = np.where(exits.unscattered[..., None], 0.0, exits.throughput) / (paths // 2)
            found.append(lights.integrals(exits.directions, throughput))
    return source.draw(0, queries), [[np.concatenate(part) for part in zip(*half, strict=True)] for half in halves]


def predicted(network: prt.NeuralBSSRDF, queries: Queries, lights: Lights, exact: bool) -> list[Array]:
    """The network's integrals; exact: with the low bands in place of those of its values."""
    weight, parts = 4.0 * np.pi / len(LATTICE), []
    for first in range(0, len(queries.keys), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        values = network.evaluate(LATTICE, queries.positions[some], queries.outgoing[some]).astype(np.float64)
        if exact:
            difference = network.up_to(2).evaluate(LATTICE, queries.positions[some], queries.outgoing[some]) - values
            harmonics = sh.evaluate(LATTICE, 2)
            values += np.einsum("dk,nkc->ndc", harmonics, weight * np.einsum("dk,ndc->nkc", harmonics, difference))
        towards = np.broadcast_to(LATTICE, values.shape)
        parts.append(lights.integrals(towards, weight * values))
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


def errors(found: list[Array], halves: list[list[Array]]) -> list[float]:
    """Relative RMSE of each function, from two independent estimates of the truth."""
    triples = zip(found, *halves, strict=True)
    squares = (((p - a) * (p - b)).sum() / (a * b).sum() for p, a, b in triples)
    return [float(np.sqrt(max(square, 0.0))) for square in squares]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--queries", type=int, default=1000)
    parser.add_argument("--paths", type=int, default=8192)
    arguments = parser.parse_args()
    scene = prt.load_scene(arguments.scene)
    lights = Lights(scene.up)
    queries, halves = traced(scene, arguments.queries, arguments.paths, lights)
    print("| network | a_lm to degree 4 | " + " | ".join(SKIES) + " |\n|---|---|" + "---|" * len(SKIES))
    for path in arguments.models:
        network = prt.load_model(str(path), mesh=scene.mesh)
        assert isinstance(network, prt.NeuralBSSRDF)
        plain = deepcopy(network)
        plain.correction = None
        rows = [("values", network, False)]
        if network.correction is not None:
            rows.insert(0, ("values without the correction", plain, False))
        if network.low is not None:
            rows.append(("values with exactly the low bands", network, True))
        for name, some, exact in rows:
            figures = errors(predicted(some, queries, lights, exact), halves)
            print(f"| {path.name}, {name} | " + " | ".join(f"{figure:.2%}" for figure in figures) + " |", flush=True)


if __name__ == "__main__":
    main()
