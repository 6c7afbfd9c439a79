"""Adaptive bakes compared with plain Monte Carlo: evaluations, time, and whether the estimated error is correct.

    python -m tests.bench.refined_bake [--error 0.01] [--seeds 6] [--others] [--subdivisions 1]
    python -m tests.bench.refined_bake --model MODEL.pt --mesh MESH [--vertices 64]

Without a model: analytic transports on 42 vertices (162, …) at 16×64 bins, with independently counted evaluations;
`--others` selects eight more. With a model: some vertices of its mesh, refined to the error, compared with a bake in
plain PyTorch: uniform directions, bin by bin, default threads, timed at 1024 directions on random bins and extrapolated
to the error by its convergence.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bakers.adaptive.evaluation_cache import NO_CACHE
from bakers.transport import on_mesh, prepared, up_to
from formats.mesh import read_mesh
from prt_bake import bake
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import first_refinement
from prt_bake.baking.adaptive.pass_settings import refined_block
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot
from prt_bake.baking.job.views import views_of
from prt_bake.jit.limits import limited_threads
from prt_bake.mathematics import sh, sphere
from prt_bake.network.bssrdf import load_model
from tests.bakers import transports as known
from tests.bakers.transports import Array, Counting, exact, icosphere, uniform_directions_needed

TUNED = known.Edged(), known.Lobed(), known.Incoherent(), known.Chequered()
OTHERS = (
    known.Clamped(),
    known.Phased(),
    known.Kinked(),
    known.TwoLobed(),
    known.KinkedPerVertex(),
    known.LobedPerVertex(),
    known.Shadowed(),
    known.Sunlit(),
)
PLAIN_DIRECTIONS, PLAIN_BINS = 1024, 192
TRUE_DIRECTIONS = 1 << 13


def analytic(transports: tuple[Any, ...], subdivisions: int, error: float, seeds: int) -> None:
    mesh = icosphere(subdivisions)
    bins = len(mesh.positions) * 1024
    print(f"{'':12}{'uniform':>9}{'ours':>8}{'fewer':>8}{'true':>8}{'est.':>8}{'p95':>8}{'est.':>8}{'within':>8}")
    for transport in transports:
        truth = exact(transport, mesh, 16, 64)
        needs = uniform_directions_needed(transport, mesh, truth, 16, 64, error)
        for seed in range(seeds):
            counted = Counting(transport)
            asset = bake(counted, mesh, error=error, seed=seed)
            difference = asset.coefficients - truth
            estimated = asset.provenance["estimated_relative_rmse"]
            by_vertex = np.sqrt((difference**2).sum(axis=(1, 2, 3)) / (truth**2).sum(axis=(1, 2, 3)))
            within = np.sqrt((difference**2).mean(axis=(2, 3))) <= 1.96 * asset.standard_error
            ours, p95 = counted.evaluations / bins, estimated["percentile_95_over_vertices"]
            print(
                f"{type(transport).__name__:12}{needs:9.0f}{ours:8.1f}{needs / ours:8.0f}"
                f"{np.sqrt((difference**2).sum() / (truth**2).sum()):8.2%}{estimated['total']:8.2%}"
                f"{np.percentile(by_vertex, 95):8.2%}{p95:8.2%}{within.mean():8.1%}",
                flush=True,
            )


def row_by_row(network: Any, incident: Array, x: Array, eye: Array) -> Array:
    """Ŝ [D,3] of one bin; the network is called on rows of (ωi, x, ωo)."""
    rows = [torch.from_numpy(np.broadcast_to(part, incident.shape).copy()) for part in (incident, x, eye)]
    with torch.no_grad():
        return network(*rows).double().numpy()


def view_once(network: Any, incident: Array, x: Array, eye: Array) -> Array:
    """Ŝ [D,3] of one bin; layers that do not depend on ωi are evaluated once."""
    return network.evaluate(incident, x[None], eye[None])[0].astype(np.float64)


def plain_bake(evaluate: Any, network: Any, positions: Array, outgoing: Array, count: int) -> tuple[Array, float]:
    """Coefficients [M,K,3] of bins from `count` uniform directions, bin by bin, and the seconds per bin."""
    began, found = time.perf_counter(), []
    for number, (x, eye) in enumerate(zip(positions, outgoing, strict=True)):
        incident = sphere.uniform(count, count + number)
        found.append(4.0 * np.pi / count * sh.evaluate(incident, 2).T @ evaluate(network, incident, x, eye))
    return np.stack(found), (time.perf_counter() - began) / len(positions)


def of_network(model: Path, mesh_path: Path, error: float, vertices: int, precision: str) -> None:
    mesh, network = read_mesh(mesh_path), load_model(model)
    bound = up_to(on_mesh(network, mesh), 2)
    transport = prepared(bound, precision, "cpu")
    views = views_of(mesh, 16, 64)
    chosen = np.sort(np.random.default_rng(5).permutation(len(mesh.positions))[:vertices])
    job = AdaptiveJob(transport, mesh, np.arange(len(mesh.positions)), views, sphere.view_bins(16, 64), 2, 0)
    with limited_threads(transport, 1):
        settings = settings_for_error(Pilot(job), first_refinement(job)[0], error)
        # Without the pilot's cached evaluations: every bin is timed.
        how = replace(settings.refinement, cache=NO_CACHE)
        began = time.perf_counter()
        cuts = range(0, len(chosen), job.block_vertices)
        parts = [refined_block(job, how, chosen[first : first + job.block_vertices])[0] for first in cuts]
        ours = (time.perf_counter() - began) / (len(chosen) * 1024)
    coefficients = np.concatenate([part.coefficients for part in parts]).astype(np.float64)
    spent = sum(part.evaluations for part in parts) / (len(chosen) * 1024)
    rows, bins = np.random.default_rng(1).integers((len(chosen), 1024), size=(PLAIN_BINS, 2)).T
    outgoing = views(chosen)[0][rows, bins]
    positions = mesh.positions[chosen[rows]]
    lattice = sphere.fibonacci(TRUE_DIRECTIONS)
    harmonics = sh.evaluate(lattice, 2)
    with limited_threads(transport, 1):
        values = prepared(bound, "float32", "cpu").evaluate_block(
            lattice[None], np.zeros((len(rows), 1), int), positions, outgoing[:, None]
        )
    truth = np.linalg.lstsq(harmonics, values[:, 0].transpose(1, 0, 2).reshape(TRUE_DIRECTIONS, -1).astype(float))[0]
    truth = truth.reshape(-1, len(rows), 3).transpose(1, 0, 2)

    def error_of(found: Array) -> float:
        return float(np.sqrt(((found - truth) ** 2).sum() / (truth**2).sum()))

    print(
        f"{model.name} {precision}, {error:.1%} requested: {error_of(coefficients[rows, bins]):.2%} (pilot's estimate "
        f"{settings.error:.2%}) with {spent:.1f} evaluations and {1e6 * ours:.0f} µs per bin, "
        f"{spent / ours / 1e6:.2f} M/s"
    )
    for name, evaluate in (("row by row", row_by_row), ("view once", view_once)):
        few = 16 if evaluate is row_by_row else len(rows)
        _found, seconds = plain_bake(evaluate, bound, positions[:few], outgoing[:few], PLAIN_DIRECTIONS)
        full, _seconds = plain_bake(view_once, bound, positions, outgoing, PLAIN_DIRECTIONS)
        quarter, _seconds = plain_bake(view_once, bound, positions, outgoing, PLAIN_DIRECTIONS // 4)
        needed = (error_of(full) / error) ** 2
        print(
            f"  plain, {name}: {1e3 * seconds:.2f} ms per bin of {PLAIN_DIRECTIONS} directions, {error_of(full):.1%} "
            f"({error_of(quarter):.1%} with a quarter), {needed * seconds:.2f} s at {error:.1%}: "
            f"{needed * seconds / ours:,.0f} times ours",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--error", type=float, default=0.01)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--others", action="store_true")
    parser.add_argument("--subdivisions", type=int, default=1)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--vertices", type=int, default=64)
    parser.add_argument("--precision", default="float32")
    args = parser.parse_args()
    if args.model is None:
        analytic(OTHERS if args.others else TUNED, args.subdivisions, args.error, args.seeds)
    else:
        of_network(args.model, args.mesh, args.error, args.vertices, args.precision)


if __name__ == "__main__":
    main()
