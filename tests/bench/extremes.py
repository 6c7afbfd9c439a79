"""Cost and soundness of path tracing extreme scenes: relative standard error, seconds, lost energy, and problems.

    python -m tests.bench.extremes [--paths 1024] [--queries 16] [--scenes]

Each scene has a row for Ŝ (one direction per query) if connections exist, and a row for a_00, over random queries.
`error` is the median standard error over the value, `unreliable` the share of flagged queries. --scenes adds the scenes
of `scenes/`, with `z`, the largest deviation of the mean of Ŝ over random directions from a_00 in standard errors.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from formats.mesh import Mesh, build_mesh
from formats.scene import Scene, read_scene
from prt_bake.tracer.estimate import Estimate, estimate_coefficients, estimate_transport
from prt_bake.tracer.prepared import prepare
from tests.tracer.nested_scenes import CLEAR, nested_scene
from tests.tracer.scenes import lumpy, make_scene, moved, queries, slab, sphere, unit_directions
from tests.tracer.soundness import SQRT_4_PI, has_connections

ROUGH: dict[str, Any] = {"eta": 1.4, "roughness": 0.3}
SCENES = Path(__file__).parents[2] / "scenes"


def _plain(mesh: Mesh, **keys: Any) -> Callable[[Path], Scene]:
    return lambda folder: make_scene(folder, mesh, **keys)


def _inside(part: dict[str, Any], **interface: Any) -> Callable[[Path], Scene]:
    medium = {"sigma_t": 3.0, "albedo": 0.9}
    return lambda folder: nested_scene(folder, slab(1.0), medium, ({"name": "inside"} | part,), **interface)


def _rare() -> np.ndarray:
    return np.where(np.random.default_rng(5).random((48, 48, 48)) < 1e-4, 1e4, 1.0)


def cases() -> dict[str, Callable[[Path], Scene]]:
    """Every case by name, as a function that writes its scene into a folder."""
    found: dict[str, Callable[[Path], Scene]] = {}
    for name, interface in (("matched", {}), ("rough", ROUGH), ("smooth", {"eta": 1.4})):
        for sigma_t in (1.0, 1e2, 1e4):
            found[f"{name}, thickness {sigma_t:g}, albedo 0.9999"] = _plain(
                moved(sphere(3), 0.5), sigma_t=sigma_t, albedo=0.9999, **interface
            )
        for phase_g in (-0.99, 0.99):
            found[f"{name}, g {phase_g:g}"] = _plain(lumpy(2), phase_g=phase_g, **interface)
        found[f"{name}, rare cells 1e4 : 1"] = _plain(sphere(3), sigma_t=_rare(), **interface)
        found[f"{name}, channels 1 : 30 : 1000"] = _plain(sphere(3), sigma_t=[0.1, 3.0, 100.0], **interface)
    for eta in (0.7, 1.0 + 1e-6, 1.01, 2.5):
        for roughness in (1e-3, 0.01, 0.1, 1.0):
            found[f"eta {eta}, roughness {roughness:g}"] = _plain(lumpy(2), eta=eta, roughness=roughness)
    found["ball in a corner"] = _inside(
        {"mesh": moved(sphere(2), 0.5, 0.2), "interface": ROUGH, "medium": CLEAR}, **ROUGH
    )
    found["inlay"] = _inside({"mesh": moved(slab(1.0), 0.5, [0.25, 0.0, 0.0]), "interface": {"eta": 1.1}}, **ROUGH)
    found["diffuse body"] = _inside({"mesh": moved(sphere(3), 0.4), "surface": "diffuse", "reflectance": 0.9}, **ROUGH)
    return found


def _problems(estimate: Estimate) -> str:
    found = []
    if not all(np.isfinite(values).all() for values in (estimate.mean, estimate.standard_error, estimate.unscattered)):
        found.append("not finite")
    if not estimate.reliable.all():
        found.append(f"{100 * (1 - estimate.reliable.mean()):.0f} % unreliable")
    dark = float((estimate.mean == 0.0).mean())
    return ", ".join(found + ([f"{100 * dark:.0f} % zeros"] if dark else []))


def _row(name: str, estimate: Estimate, values: np.ndarray, errors: np.ndarray, more: str = "") -> None:
    positive = values > 0.0
    error = float(np.median(errors[positive] / values[positive])) if positive.any() else np.nan
    lost = float(estimate.lost.max())
    print(f"{name:46}{error:10.3g}{estimate.seconds:10.2f}{lost:8.2g}  {_problems(estimate)}{more}", flush=True)


def measure(name: str, scene: Scene, count: int, paths: int) -> None:
    """Print the rows of a scene."""
    positions, outgoing, _ = queries(scene.mesh, count, 11)
    if has_connections(scene):
        values = estimate_transport(scene, positions, outgoing, unit_directions(count, 12), paths, 1)
        _row(f"{name}: S", values, values.mean, values.standard_error)
    exits = estimate_coefficients(scene, positions, outgoing, 0, paths, 1)
    _row(f"{name}: a_00", exits, exits.mean, exits.standard_error)


def agreement(scene: Scene, count: int, paths: int, batches: int = 16) -> str:
    """The largest z of the difference between 4π times the mean of Ŝ over random directions and the exits' mean."""
    positions, outgoing, _ = queries(scene.mesh, count, 11)
    means = []
    for seed in range(batches):
        incident = unit_directions(64 * count, 100 + seed).reshape(count, 64, 3)
        means.append(
            4.0 * np.pi * estimate_transport(scene, positions, outgoing, incident, paths, seed).mean.mean(axis=1)
        )
    exits = estimate_coefficients(scene, positions, outgoing, 0, batches * paths, 999)
    error = np.hypot(np.std(means, axis=0, ddof=1) / np.sqrt(batches), SQRT_4_PI * exits.standard_error[:, 0])
    z = (np.mean(means, axis=0) - SQRT_4_PI * exits.mean[:, 0]) / error
    ratio = np.mean(means) / np.mean(SQRT_4_PI * exits.mean[:, 0])
    return f"  z {np.abs(z).max():.1f} of {z.size}, ratio {ratio:.3f}"


def large(folder: Path) -> dict[str, Scene]:
    """Scenes of many cells and many faces."""
    generator = np.random.default_rng(6)
    grid = generator.uniform(1.0, 7.0, (256, 256, 256)).astype(np.float32)
    grid[generator.integers(0, 256, 500), 128, 128] = 1e4
    ball = trimesh.creation.uv_sphere(radius=1.0, count=[320, 320])
    many = build_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    for name in ("cells", "faces"):
        (folder / name).mkdir()
    return {
        "a grid of 256³ cells": make_scene(folder / "cells", lumpy(2), sigma_t=grid, albedo=1.0),
        f"{len(many.faces):,} faces": make_scene(folder / "faces", many, sigma_t=8.0, albedo=0.9, **ROUGH),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--paths", type=int, default=1024)
    parser.add_argument("--queries", type=int, default=16)
    parser.add_argument("--scenes", action="store_true")
    args = parser.parse_args()
    print(f"{'case':46}{'error':>10}{'seconds':>10}{'lost':>8}  problems")
    for name, write in cases().items():
        with tempfile.TemporaryDirectory() as folder:
            measure(name, write(Path(folder)), args.queries, args.paths)
    with tempfile.TemporaryDirectory() as folder:
        for name, scene in large(Path(folder)).items():
            begun = time.perf_counter()
            prepare(scene)
            print(f"{'preparing ' + name:46}{'':10}{time.perf_counter() - begun:10.2f}", flush=True)
    for path in sorted(SCENES.glob("*/*.toml")) if args.scenes else []:
        try:
            scene = read_scene(path)
        except OSError as error:
            print(f"{path.stem:46}{error}")
            continue
        measure(path.stem, scene, args.queries, args.paths)
        if has_connections(scene):
            print(f"{path.stem}: connections and exits{agreement(scene, 8, args.paths // 4)}", flush=True)


if __name__ == "__main__":
    main()
