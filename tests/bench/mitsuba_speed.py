"""Efficiency of path tracing on one thread, compared with Mitsuba 3 on the same queries and machine.

    python -m tests.bench.mitsuba_speed [--queries 20] [--seed 1]

Efficiency is 1 / (relative variance · seconds), as a geometric mean over queries; queries darker than 2 % of the
brightest are ignored. Variances are those of the means of 64 independent batches. Every second line has 64 lights per
query, in one call here and one after another in Mitsuba. Mitsuba runs in its faster variant for each scene. Its paths
start just below the surface, which saves it the path from the camera and its ray offset of about 1e-4, a bias in dense
media.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np

from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.mathematics.directions import fibonacci
from tests.bench.efficiency import Batches, Run, ours, paths_for, timed
from tests.bench.mitsuba_variant import working_variants
from tests.tracer.half_space import reflected
from tests.tracer.scenes import blotches, lumpy, make_scene, moved, queries, sphere, unit_directions

DIRECTIONS = 64
SAMPLED_DIRECTIONS = 2
DARK = 0.02
SEVERAL_BAR = 20.0
OWN_SECONDS = 0.1
THICK_ALBEDO = 0.999


@dataclass(frozen=True)
class Case:
    """A scene with longest side 1, the required ratio of efficiencies, and the seconds of a run of Mitsuba.

    Mitsuba's kernels run with few active lanes at the end of the longest paths, so dense scenes need longer runs.
    """

    name: str
    mesh: Callable[[], Mesh]
    keys: dict[str, Any]
    bar: float
    mitsuba_seconds: float = 0.25


def _unit_sphere() -> Mesh:
    return moved(sphere(4), 0.5)


def _unit_lumpy() -> Mesh:
    mesh = lumpy(4)
    return moved(mesh, 1.0 / float(np.ptp(mesh.bounds, axis=0).max()))


CASES = (
    Case("sphere, matched, sigma_t 5", _unit_sphere, {"sigma_t": 5.0, "albedo": 0.9}, 2.0),
    Case(
        "sphere, GGX 0.3, eta 1.4, sigma_t 5",
        _unit_sphere,
        {"sigma_t": 5.0, "albedo": 0.99, "eta": 1.4, "roughness": 0.3},
        10.0,
    ),
    Case(
        "non-convex grid, GGX 0.25, eta 1.3",
        _unit_lumpy,
        {
            "sigma_t": 20.0 * blotches((16, 16, 16), 20.0, 3),
            "albedo": np.random.default_rng(4).uniform(0.7, 1.0, (16, 16, 16)),
            "eta": 1.3,
            "roughness": 0.25,
        },
        20.0,
    ),
    Case("sphere, matched, sigma_t 500", _unit_sphere, {"sigma_t": 500.0, "albedo": THICK_ALBEDO}, 5.0, 0.5),
)


def theirs(world: Any, position: np.ndarray, outgoing: np.ndarray, incident: np.ndarray) -> Batches:
    """Mitsuba with one light [3]."""

    def batches(paths: int, seed: int) -> tuple[np.ndarray, float]:
        means, seconds = world.batch_means(position, outgoing, incident, paths, seed)
        return means.mean(axis=1, keepdims=True), seconds

    return batches


@dataclass(frozen=True)
class Pair:
    """A value of Ŝ by both programs, and the cosines of its directions with the face normal."""

    own: Run
    other: Run
    outgoing_cosine: float
    incident_cosine: float


def pairs(case: Case, world: Any, scene: Scene, count: int, seed: int, lights: np.ndarray | None) -> list[Pair]:
    """Values with a separate light for each query, or with `lights` [D,3], SAMPLED_DIRECTIONS of which are compared."""
    positions, outgoing, normals = queries(scene.mesh, count, seed)
    chosen = [0] if lights is None else np.random.default_rng(seed).permutation(DIRECTIONS)[:SAMPLED_DIRECTIONS]
    found: list[Pair] = []
    own_paths = other_paths = 0
    for n, incident in enumerate(unit_directions(count, seed + 9)):
        directions = incident[None] if lights is None else lights
        batches = ours(scene, positions[n], outgoing[n], directions)
        own_paths = own_paths or paths_for(batches, OWN_SECONDS)
        own = timed(batches, own_paths, n)
        for d in chosen:
            batches = theirs(world, positions[n], outgoing[n], directions[d])
            other_paths = other_paths or paths_for(batches, case.mitsuba_seconds)
            other = timed(batches, other_paths, n)
            other = Run(other.mean, other.variance, other.seconds * len(directions))
            one = Run(own.mean[d : d + 1], own.variance[d : d + 1], own.seconds)
            found.append(Pair(one, other, float(outgoing[n] @ normals[n]), float(directions[d] @ normals[n])))
    return found


def fastest(case: Case, scene: Scene, variants: list[str]) -> Any:
    """Mitsuba's scene in the variant with the most paths per second for one query."""
    from tests.bench.mitsuba_paths import MitsubaPaths

    (position,), (outgoing,), _ = queries(scene.mesh, 1, 0)
    seconds = []
    for variant in variants:
        batches = theirs(MitsubaPaths(scene, variant), position, outgoing, outgoing)
        seconds.append(timed(batches, paths_for(batches, case.mitsuba_seconds), 0).seconds)
    return MitsubaPaths(scene, variants[int(np.argmin(seconds))])


def line(case: Case, several: bool, found: list[Pair]) -> str:
    """A line with both efficiencies, their ratio and its bound, paths/s and relative variances, as geometric means."""
    mean = np.array([pair.own.mean[0] for pair in found])
    variance = np.array([[run.variance[0] for run in (pair.own, pair.other)] for pair in found])
    seconds = np.array([[run.seconds for run in (pair.own, pair.other)] for pair in found])
    kept = (mean >= DARK * mean.max()) & (variance > 0.0).all(axis=1)
    noise = np.exp(np.log(variance[kept] / mean[kept, None] ** 2).mean(axis=0))
    rate = np.exp(-np.log(seconds[kept]).mean(axis=0))
    efficiency = rate / noise
    bar, lights = (SEVERAL_BAR, DIRECTIONS) if several else (case.bar, 1)
    return (
        f"{case.name:37}{lights:7}{efficiency[0]:12,.0f}{efficiency[1]:12,.0f}{efficiency[0] / efficiency[1]:8.1f}"
        f"{bar:6.0f}{rate[0]:12,.0f}{rate[1] * lights:12,.0f}{noise[0]:9.3g}{noise[1]:9.3g}"
        f"{kept.sum():5} of {len(found)}"
    )


def against_theory(found: list[Pair]) -> str:
    """Both programs' values over those of a half space, lit and viewed from above; both see the sphere's curvature."""
    above = [pair for pair in found if min(pair.outgoing_cosine, pair.incident_cosine) > 0.3]
    cosines = np.array([[pair.outgoing_cosine, pair.incident_cosine] for pair in above])
    theory = reflected(THICK_ALBEDO, *cosines.T)
    own, other = (
        np.array([run.mean[0] for run in runs]) / theory for runs in ([p.own for p in above], [p.other for p in above])
    )
    return (
        f"  over Chandrasekhar's half space, {len(above)} queries: ours {own.mean():.3f} ± {own.std():.3f}, "
        f"Mitsuba {other.mean():.3f} ± {other.std():.3f} (spread over queries)"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--queries", type=int, default=20)
    parser.add_argument("--several-queries", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    variants, libraries = working_variants()
    numba.set_num_threads(1)

    import drjit
    import mitsuba

    drjit.set_thread_count(1)
    print(f"Mitsuba {mitsuba.__version__}; {libraries}; one thread each")
    print(
        f"{'scene':37}{'lights':>7}{'efficiency':>12}{'Mitsuba':>12}{'ratio':>8}{'aim':>6}{'paths/s':>12}{'Mitsuba':>12}"
        f"{'variance':>9}{'Mitsuba':>9}  values"
    )
    for case in CASES:
        with tempfile.TemporaryDirectory() as folder:
            scene = make_scene(Path(folder), case.mesh(), **case.keys)
        world = fastest(case, scene, variants)
        found = pairs(case, world, scene, args.queries, args.seed, None)
        print(f"{line(case, False, found)}  {world.variant}", flush=True)
        if case is CASES[-1]:
            print(against_theory(found), flush=True)
        many = pairs(case, world, scene, args.several_queries, args.seed + 1, fibonacci(DIRECTIONS))
        print(f"{line(case, True, many)}  {world.variant}", flush=True)


if __name__ == "__main__":
    main()
