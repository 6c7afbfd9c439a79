"""Error of baked coefficients by evaluations of Ŝ, for several methods of choosing the directions of incidence.

    python -m tests.bench.bake_error [--model MODEL.pt --mesh MESH] [--out bench]

Prints the relative RMSE by directions per view bin, each method's slope, and how many times fewer evaluations it needs
than uniform Monte Carlo at 1 %; plots the same. The transports are two analytic ones (a clamped cosine with a shadow's
edge; lobes about the view) and, if given, a network on a mesh.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bakers.baker import Sampling, Task, bake_block
from bakers.horizon import clamp_to_horizon
from bakers.projection import direction_pool
from formats.mesh import Mesh, read_mesh
from prt_bake.baking.job.sampling import DirectionKind, direction_sets
from prt_bake.baking.job.views import horizons
from prt_bake.mathematics import sh, sphere
from prt_bake.network.bssrdf import load_model

Array = NDArray[np.float64]

DEGREE = 2
RINGS, SECTORS, VERTICES, SEEDS = 2, 32, 4, 2
TARGET = 0.01
REFERENCE_DIRECTIONS = 1 << 15


@dataclass(frozen=True)
class Method:
    """A method of choosing directions and weights."""

    name: str
    kind: DirectionKind
    fitted: bool
    half_sets: bool
    directions: tuple[int, ...]


METHODS = (
    Method("uniform Monte Carlo", "uniform", False, False, tuple(4**k for k in range(2, 9))),
    Method("scrambled Sobol", "sobol", False, False, tuple(2**k for k in range(4, 12))),
    Method("rotated lattice, equal weights", "fibonacci", False, False, tuple(2**k for k in range(4, 12))),
    Method("two half-size lattices, fitted", "fibonacci", True, True, tuple(2**k for k in range(5, 12))),
    Method("rotated lattice, fitted (default)", "fibonacci", True, False, tuple(2**k for k in range(4, 12))),
)


class Shadowed:
    """A clamped cosine about the normal of a unit sphere, cut by a shadow's edge."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        lit = np.where(incident[..., 0] > 0.4 * positions[:, None, 1], 1.0, 0.5)
        return np.stack([cosine * lit, cosine, cosine**2 + 0.05], axis=-1)


class Lobed:
    """A forward lobe about −ωo on a diffuse floor, as of a thin translucent sheet."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        forward = np.exp(8.0 * (-np.einsum("ndi,ni->nd", incident, outgoing) - 1.0))
        facing = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        return np.stack([forward + 0.3 * facing, 0.7 * forward + 0.2 * facing, 0.5 * forward + 0.1], axis=-1)


def bench_sphere() -> Mesh:
    from formats.mesh import build_mesh

    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
    return build_mesh(corners, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))


def baker_of(transport: Any, mesh: Mesh) -> Callable[[Method, int, int], Array]:
    """A function (method, directions per bin, seed) → coefficients [V,B,K,3] at a few vertices of the mesh."""
    vertices = np.random.default_rng(1).permutation(len(mesh.positions))[:VERTICES]
    normals = mesh.normals[vertices]
    world = sphere.to_world(sphere.view_bins(RINGS, SECTORS), normals[:, None], sphere.tangent_frame(normals)[:, None])
    outgoing = clamp_to_horizon(world, horizons(mesh), vertices)[0]
    bins = RINGS * SECTORS

    def bake(method: Method, directions: int, seed: int) -> Array:
        size = directions // 2 if method.half_sets else directions
        incident = direction_sets(method.kind, size, seed)
        pool = direction_pool(incident, sh.evaluate(incident, DEGREE), method.fitted)
        taken = np.random.default_rng(seed).integers(0, len(incident), (len(vertices), bins))
        other = (taken + len(incident) // 2) % len(incident)
        estimator = "halves" if method.half_sets else "neighbours"
        second = (lambda a, b: other[a:b]) if method.half_sets else None
        sampling = Sampling(pool, lambda a, b: taken[a:b], second, estimator)
        task = Task(transport, mesh.positions[vertices], lambda chosen: (outgoing[chosen], 0), bins, SECTORS, sampling)
        return np.concatenate(
            [bake_block(task, v, v + 1).coefficients.astype(np.float64) for v in range(len(vertices))]
        )

    return bake


def measure(transport: Any, mesh: Mesh) -> dict[Method, Array]:
    """Relative RMSE of every method at each of its numbers of directions."""
    bake = baker_of(transport, mesh)
    truth = bake(METHODS[-1], REFERENCE_DIRECTIONS, 1000)
    errors: dict[Method, Array] = {}
    for method in METHODS:
        squares = [
            np.mean([((bake(method, directions, seed) - truth) ** 2).sum() for seed in range(SEEDS)])
            for directions in method.directions
        ]
        errors[method] = np.sqrt(np.array(squares) / (truth**2).sum())
    return errors


def slope(method: Method, errors: Array) -> float:
    """Exponent p of error ≈ directions^p, fitted by least squares in logarithms."""
    return float(np.polyfit(np.log(method.directions), np.log(errors), 1)[0])


def needed(method: Method, errors: Array) -> float:
    """Directions per bin at which the error falls to the target, between measured points or past them by the slope."""
    logs, counts = np.log(errors), np.log(method.directions)
    below = np.flatnonzero(errors <= TARGET)
    if below.size and below[0] > 0:
        first = below[0]
        share = (logs[first - 1] - np.log(TARGET)) / (logs[first - 1] - logs[first])
        return float(np.exp(counts[first - 1] + share * (counts[first] - counts[first - 1])))
    if below.size:
        return float(method.directions[0])
    return float(np.exp(counts[-1] + (np.log(TARGET) - logs[-1]) / slope(method, errors)))


def table(name: str, errors: dict[Method, Array]) -> str:
    """The figures of one transport as plain text."""
    columns = sorted({directions for method in METHODS for directions in method.directions})
    lines = [f"\n{name}: relative RMSE of degree-{DEGREE} coefficients by directions per view bin"]
    lines.append(f"{'':36}" + "".join(f"{column:>9}" for column in columns) + "    slope   at 1 %    fewer")
    baseline = needed(METHODS[0], errors[METHODS[0]])
    for method, values in errors.items():
        at = dict(zip(method.directions, values, strict=True))
        cells = "".join(f"{at[column]:9.2g}" if column in at else f"{'':9}" for column in columns)
        count = needed(method, values)
        lines.append(f"{method.name:36}{cells} {slope(method, values):8.2f} {count:8.0f} {baseline / count:7.0f}×")
    return "\n".join(lines)


def plot(results: dict[str, dict[Method, Array]], path: Path) -> None:
    """One log-log panel for each transport."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(results), figsize=(5.2 * len(results), 4.4), sharey=True, squeeze=False)
    for panel, (name, errors) in zip(panels[0], results.items(), strict=True):
        for method, values in errors.items():
            panel.loglog(method.directions, values, marker="o", markersize=3, label=method.name)
        panel.axhline(TARGET, color="black", linewidth=0.8, linestyle=":")
        panel.set(title=name, xlabel="evaluations of Ŝ per view bin")
        panel.grid(True, which="major", alpha=0.3)
    panels[0][0].set_ylabel("relative RMSE of the coefficients")
    panels[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="a network's checkpoint; needs --mesh")
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--out", type=Path, default=Path("bench"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    transports: dict[str, tuple[Any, Mesh]] = {
        "clamped cosine with a shadow's edge": (Shadowed(), bench_sphere()),
        "forward lobe on a diffuse floor": (Lobed(), bench_sphere()),
    }
    if args.model is not None:
        if args.mesh is None:
            parser.error("--model needs --mesh")
        mesh = read_mesh(args.mesh)
        transports[f"network {args.model.name}"] = load_model(args.model, mesh=mesh).prepared(), mesh
    results = {}
    for name, (transport, mesh) in transports.items():
        results[name] = measure(transport, mesh)
        print(table(name, results[name]), flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    plot(results, args.out / "bake_error.png")
    print(f"\nplot: {args.out / 'bake_error.png'}")


if __name__ == "__main__":
    main()
