"""Ablation of the network and its training: the default and its variants, each trained for the same time.

    python -m tests.bench.training [SCENE.toml] [--minutes 1] [--only WORDS] [--out bench/training.json]

Prints the relative RMSE of Ŝ and of a_lm on fresh queries, and of a_lm over vertices as in a bake, all corrected for
the reference's noise; the paths, the steps, and the size of the model file. `--only` selects variants whose names
contain one of the words. The paper's network is one of the variants.

`train` removes inputs that are useless for a scene: variants of lobes and of the refracted ray differ from the default
only on clear objects.
"""

import argparse
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from formats.scene import Scene, read_scene
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, save_model
from prt_bake.shipped.demonstration import SHIPPED
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.prepared import prepare, smooth_part
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.report.evaluation import vertex_views
from prt_bake.trainer.samples.rows import StreamSettings
from prt_bake.trainer.train import train
from prt_bake.trainer.validation import HeldOutCoefficients, hold_out, hold_out_coefficients

OURS = PRESETS["measured"]
PLAIN = replace(
    OURS,
    features=256,
    ray_samples=0,
    tells_normal=False,
    interfaces=0,
    lobes=0,
    shape_places=0,
    grid_places=0,
    light_places=0,
    low_axes=False,
)
"""Features of the position alone, without the interior."""
EARLY: dict[str, Any] = {"light_layers": 0, "low_width": 0, "angle_powers": 0, "skips": ((1, 3), (2, 4))}
"""ωi enters the first layer."""
STREAM = StreamSettings()
LEARNING = LearningSettings(held_out_queries=256)
"""With few validation queries: the printed errors are measured here."""
QUERIES, VERTICES, VIEWS, WALKS, SEED = 1024, 256, 4, 256, 0xAB1A


@dataclass(frozen=True)
class Variant:
    """The settings of one training."""

    network: NetworkSettings = OURS
    stream: StreamSettings = STREAM
    learning: LearningSettings = LEARNING


def network(**changes: Any) -> Variant:
    return Variant(network=replace(OURS, **changes))


def plain(**changes: Any) -> Variant:
    return Variant(network=replace(PLAIN, **changes))


def stream(**changes: Any) -> Variant:
    return Variant(stream=replace(STREAM, **changes))


def learning(**changes: Any) -> Variant:
    return Variant(learning=replace(LEARNING, **changes))


def deep(layers: int, skipping: bool) -> Variant:
    """A network of `layers` hidden layers, two of them after ωi enters, with a skip to every second layer."""
    skips = tuple((layer - 2, layer) for layer in range(3, layers - 1, 2)) if skipping else ()
    return network(layers=layers, skips=skips)


VARIANTS: dict[str, Variant] = {
    "default": Variant(),
    "default, another seed": network(seed=1),
    "30 % on vertices and edges": stream(edge_share=0.3),
    "paper preset": Variant(network=PRESETS["paper"]),
    "no ray": plain(),
    "no normal, no lobes": network(tells_normal=False, interfaces=0, lobes=0),
    "no lobes": network(lobes=0),
    "1 lobe": network(lobes=1),
    "4 lobes": network(lobes=4),
    "no grid": network(grid_places=0),
    "no material": network(material_channels=0),
    "grid of 24 nodes": network(grid_places=24),
    "grid of 48 nodes": network(grid_places=48),
    "4 features per node": network(grid_numbers=4),
    "16 features per node": network(grid_numbers=16),
    "96 Fourier features": network(features=96),
    "no shape": network(shape_places=0),
    "shape at x alone": network(shape_places=1),
    "no occupancy towards the light": network(light_places=0),
    "8 places towards the light": network(light_places=8),
    "24 places towards the light": network(light_places=24),
    "no cosines to the light": network(light_cosines=False),
    "no angle": network(angle_powers=0),
    "4 powers of the angle": network(angle_powers=4),
    "no ray, light enters first": plain(**EARLY),
    "light enters at the last layer": network(light_layers=1),
    "light enters at layer 3": network(light_layers=3),
    "no ray, directions spherical": plain(directions="spherical"),
    "no ray, mean of G 18": plain(feature_mean=18.0),
    "spread of G 0.25": network(position_spread=0.25, feature_spread=0.25),
    "spread of G 0.6 (positions)": network(position_spread=0.6),
    "spread of G 2.4 (positions)": network(position_spread=2.4),
    "spread of G 0.1 (directions)": network(feature_spread=0.1),
    "spread of G 0.4 (directions)": network(feature_spread=0.4),
    "activation relu": network(activation="relu"),
    **{f"depth {layers}": deep(layers, True) for layers in (4, 6, 7)},
    **{f"depth {layers} without skips": deep(layers, False) for layers in (3, 4, 5, 6, 7)},
    "no weight decay": learning(decay=0.0),
    "weight decay 0.1": learning(decay=0.1),
    "rate 0.001": learning(rate=1e-3),
    "rate 0.002": learning(rate=2e-3),
    "rate 0.008": learning(rate=8e-3),
    "float32": learning(bfloat16=False),
    "batch 256": learning(batch=256),
    "batch 1024": learning(batch=1024),
    "6 samples of the ray": network(ray_samples=6, material_parts=3),
    "24 samples of the ray": network(ray_samples=24),
    "no ray, light enters first, narrow spread": plain(**EARLY, feature_spread=0.09),
    "view ray not refracted inside": network(interfaces=0),
    "values": stream(rays="values", walks=1, connections=4),
    "queries by area alone": stream(face_share=0.0),
    "rows used twice": stream(reuse=2),
    "a learner that never waits": stream(reuse=1000),
    "4 paths per query, 8 directions in addition": Variant(
        stream=replace(STREAM, exits=4, kept=4), learning=replace(LEARNING, spread=8, coarse_steps=0)
    ),
    "8 paths per query": stream(exits=8, kept=8),
    "at most 64 paths per query": stream(exits=64),
    "32 paths per query, each a ray": stream(least_exits=32, kept=32),
    "6 rays per query": stream(kept=6),
    "no coarse steps": learning(coarse_steps=0),
    "1000 coarse steps": learning(coarse_steps=1000),
    "8 directions in addition to the exits": learning(spread=8),
    "24 directions in addition to the exits": learning(spread=24),
    "1 path per value": stream(rays="values", walks=1),
    "4 paths per value": stream(rays="values", walks=4),
}


class Truth:
    """Path-traced references of all variants: Ŝ if it has values, and a_lm."""

    def __init__(self, scene: Scene) -> None:
        """Path trace the references."""
        prepared = prepare(scene)
        self._values = hold_out(prepared, QUERIES, 8, WALKS, SEED) if smooth_part(scene) is None else None
        self._coefficients = hold_out_coefficients(scene, QUERIES, 8 * WALKS, SEED, directions=256)
        positions, outgoing = vertex_views(prepared, VERTICES, VIEWS, SEED).flat()
        traced = estimate_coefficients(scene, positions, outgoing, 2, 8 * WALKS, SEED + 2)
        self._vertices = HeldOutCoefficients(positions, outgoing, traced.mean, traced.standard_error, directions=256)

    def errors(self, network: NeuralBSSRDF) -> dict[str, float | None]:
        """The relative RMSE of a network."""
        return {
            "transport": None if self._values is None else self._values.relative_rmse(network),
            "coefficients": self._coefficients.relative_rmse(network),
            "vertices": self._vertices.relative_rmse(network),
        }


def trained(scene: Scene, variant: Variant, minutes: float, truth: Truth) -> dict[str, Any]:
    """The errors, walks, steps and size of one training."""
    model = train(
        scene,
        minutes=minutes,
        settings=variant.network,
        stream=variant.stream,
        learning=variant.learning,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.pt"
        save_model(model, path)
        size = path.stat().st_size / 1024
    training = model.metadata["training"]
    return {**truth.errors(model.on(scene.mesh)), "walks": training["walks"], "steps": training["steps"], "kib": size}


def main() -> None:
    """Train every variant and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=SHIPPED / "spot.toml")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    scene = read_scene(args.scene)
    truth = Truth(scene)
    head = f"{'variant':46}{'error of S':>11}{'of a_lm':>9}{'vertices':>10}{'paths':>12}{'steps':>8}{'KiB':>6}"
    print(f"{head}   ({args.minutes:g} minutes)")
    rows = {}
    for name, variant in VARIANTS.items():
        if args.only and not any(word in name for word in args.only):
            continue
        row = rows[name] = trained(scene, variant, args.minutes, truth)
        transport = "" if row["transport"] is None else f"{row['transport']:.4f}"
        print(
            f"{name:46}{transport:>11}{row['coefficients']:9.4f}{row['vertices']:10.4f}"
            f"{row['walks']:12,}{row['steps']:8,}{row['kib']:6.0f}",
            flush=True,
        )
        if args.out is not None:
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
