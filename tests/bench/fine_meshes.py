"""Interpolation of vertices on fine meshes: the evaluations that it saves and its true error.

    python -m tests.bench.fine_meshes --subdivisions 5
    python -m tests.bench.fine_meshes --subdivisions 2 \
        --model prt_bake/shipped/spot.pt --mesh prt_bake/shipped/spot.obj

Spheres with analytic transports, or a network's mesh, are subdivided (Loop) and baked twice: with every vertex
evaluated and with most vertices interpolated. The truth is a fit over 4096 directions at random bins.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import prt_bake.baking.adaptive.tolerances
from bakers.evaluation import values_at
from bakers.transport import on_mesh, prepared, up_to
from formats.mesh import Mesh, build_mesh, read_mesh
from prt_bake import bake
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sh, sphere
from prt_bake.network.bssrdf import load_model
from tests.bakers.transports import Edged, Lobed, Ringed, icosphere

VERTICES, BINS, DIRECTIONS = 150, 4, 4096
NONE = "every vertex evaluated"


def subdivided(path: Path, times: int) -> Mesh:
    mesh = read_mesh(path)
    fine = trimesh.Trimesh(mesh.positions, mesh.faces).subdivide_loop(times)
    return build_mesh(np.asarray(fine.vertices), np.asarray(fine.faces))


def true_errors(transport: Any, mesh: Mesh, rings: int, sectors: int, asset: Any) -> tuple[float, float, float]:
    """Relative RMSE, its 95th percentile over vertices, and the share of bins within 1.96 standard errors."""
    random, lattice, views = np.random.default_rng(1), sphere.fibonacci(DIRECTIONS), views_of(mesh, rings, sectors)
    fit = np.linalg.pinv(sh.evaluate(lattice, 2))
    errors, signal, stated = [], [], []
    for vertex in random.choice(len(mesh.positions), VERTICES, replace=False):
        bins = np.sort(random.choice(rings * sectors, BINS, replace=False))
        outgoing = views(np.array([vertex]))[0][0, bins]
        x = np.tile(mesh.positions[vertex], (BINS, 1))
        values = values_at(transport, lattice[None], np.zeros(BINS, np.int64), x, outgoing).astype(np.float64)
        truth = (fit @ values).reshape(BINS, -1, 3)
        errors.append(((asset.coefficients[vertex, bins] - truth) ** 2).mean(axis=(1, 2)))
        signal.append((truth**2).mean(axis=(1, 2)))
        stated.append(asset.standard_error[vertex, bins])
    squared, squares, stated_error = np.array(errors), np.array(signal), np.array(stated)
    by_vertex = np.sqrt(squared.sum(axis=1) / squares.sum(axis=1))
    within = (np.sqrt(squared) <= 1.96 * stated_error).mean()
    return float(np.sqrt(squared.sum() / squares.sum())), float(np.percentile(by_vertex, 95)), float(within)


def one(name: str, transport: Any, mesh: Mesh, error: float, rings: int, sectors: int) -> None:
    chosen = prt_bake.baking.adaptive.tolerances.choose_interpolation
    for mode in (NONE, "most interpolated"):
        prt_bake.baking.adaptive.tolerances.choose_interpolation = (lambda *_all: (None, 0)) if mode == NONE else chosen
        began = time.perf_counter()
        with bake(transport, mesh, error=error, rings=rings, sectors=sectors) as asset:
            seconds, provenance = time.perf_counter() - began, asset.provenance
            bins = len(mesh.positions) * rings * sectors
            exact = prepared(up_to(on_mesh(transport, mesh), 2), "float32", "cpu")
            true, worst, within = true_errors(exact, mesh, rings, sectors, asset)
        print(
            f"{name}, {len(mesh.positions)} vertices, {error:.1%}, {mode}: {provenance['evaluations'] / bins:.2f} "
            f"evaluations per bin, {seconds:.0f} s, "
            f"{provenance['refinement']['vertices_interpolated'] / len(mesh.positions):.0%} interpolated, error: "
            "estimated "
            f"{provenance['estimated_relative_rmse']['total']:.2%}, true {true:.2%}, 95 % of the vertices {worst:.2%}, "
            f"{within:.1%} within",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--error", type=float, default=0.01)
    parser.add_argument("--rings", type=int, default=16)
    parser.add_argument("--sectors", type=int, default=64)
    parser.add_argument("--subdivisions", type=int, default=5)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--mesh", type=Path)
    args = parser.parse_args()
    if args.model is not None:
        mesh = subdivided(args.mesh, args.subdivisions)
        one(args.model.name, load_model(args.model), mesh, args.error, args.rings, args.sectors)
        return
    cases: dict[str, Any] = {"ringed": Ringed(), "lobed": Lobed(), "edged": Edged()}
    for name, transport in cases.items():
        one(name, transport, icosphere(args.subdivisions), args.error, args.rings, args.sectors)


if __name__ == "__main__":
    main()
