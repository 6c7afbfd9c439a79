"""Which network and which training: the default against its variants, each trained for the same time.

    python -m tests.bench.training [SCENE.toml] [--minutes 1] [--only WORDS] [--out bench/training.json]

Prints the relative RMSE of Ŝ and of a_lm on fresh queries, the same for all, and of a_lm over vertices as a bake asks
(reference noise taken out); the walks, the steps, and the model's size on disk. `--only` keeps the variants whose names
hold one of the words. The paper's network is among them.

What a scene does not need is left out of every variant (`trainer.fit`): those of lobes and turns of the ray differ from
the default on clear objects alone.
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
from prt_bake.trainer.learner import LearningSettings
from prt_bake.trainer.report.evaluation import vertex_views
from prt_bake.trainer.samples.rows import StreamSettings
from prt_bake.trainer.train import train
from prt_bake.trainer.validation import HeldOutCoefficients, hold_out, hold_out_coefficients

OURS = PRESETS["measured"]
PLAIN = replace(
    OURS, features=256, ray_samples=0, tells_normal=False, lobes=0, shape_places=0, grid_places=0, light_places=0
)
"""With features of the position itself, and nothing told of the inside."""
EARLY: dict[str, Any] = {"light_layers": 0, "angle_powers": 0, "skips": ((1, 3), (2, 4))}
"""ωi enters the first layer, and nothing is told late."""
ASKING = StreamSettings()
LEARNING = LearningSettings(held_out_queries=256)
"""With little to watch a training by: what is printed is measured here."""
QUERIES, VERTICES, VIEWS, WALKS, SEED = 1024, 256, 4, 256, 0xAB1A


@dataclass(frozen=True)
class Variant:
    """What differs from the default."""

    network: NetworkSettings = OURS
    stream: StreamSettings = ASKING
    learning: LearningSettings = LEARNING


def network(**differing: Any) -> Variant:
    return Variant(network=replace(OURS, **differing))


def plain(**differing: Any) -> Variant:
    return Variant(network=replace(PLAIN, **differing))


def stream(**differing: Any) -> Variant:
    return Variant(stream=replace(ASKING, **differing))


def learning(**differing: Any) -> Variant:
    return Variant(learning=replace(LEARNING, **differing))


def deep(layers: int, skipping: bool) -> Variant:
    """Hidden layers in all, two of them after ωi has entered; every second one is joined to the one before last."""
    skips = tuple((layer - 2, layer) for layer in range(3, layers - 1, 2)) if skipping else ()
    return network(layers=layers, skips=skips)


VARIANTS: dict[str, Variant] = {
    "default": Variant(),
    "default, another seed": network(seed=1),
    "30 % on vertices and edges": stream(edge_share=0.3),
    "paper preset": Variant(network=PRESETS["paper"]),
    "no ray": plain(),
    "no normal, no lobes": network(tells_normal=False, lobes=0),
    "no lobes": network(lobes=0),
    "1 lobe": network(lobes=1),
    "4 lobes": network(lobes=4),
    "no grid": network(grid_places=0),
    "grid of 24 places": network(grid_places=24),
    "grid of 48 places": network(grid_places=48),
    "4 numbers at a place": network(grid_numbers=4),
    "16 numbers at a place": network(grid_numbers=16),
    "96 Fourier features": network(features=96),
    "no shape": network(shape_places=0),
    "shape at x alone": network(shape_places=1),
    "no way to the light": network(light_places=0),
    "8 places on the way to the light": network(light_places=8),
    "24 places on the way to the light": network(light_places=24),
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
    "loss relative": learning(loss="relative"),
    "no decay of weights": learning(decay=0.0),
    "decay of weights 0.1": learning(decay=0.1),
    "rate 0.001": learning(rate=1e-3),
    "rate 0.002": learning(rate=2e-3),
    "rate 0.008": learning(rate=8e-3),
    "rate constant": learning(schedule="constant"),
    "rate exponential": learning(schedule="exponential"),
    "no average": learning(average=False),
    "float32": learning(bfloat16=False),
    "batch 256": learning(batch=256),
    "batch 1024": learning(batch=1024),
    "6 samples of the ray": network(ray_samples=6),
    "24 samples of the ray": network(ray_samples=24),
    "no ray, light enters first, narrow spread": plain(**EARLY, feature_spread=0.09),
    "no turns of the ray": network(ray_turns=0),
    "values": stream(rays="values", walks=1, connections=4),
    "exits": stream(rays="exits"),
    "queries by area alone": stream(face_share=0.0),
    "rows learnt from twice": stream(reuse=2),
    "a learner that never waits": stream(reuse=1000),
    "4 walks a query, 8 directions besides": Variant(
        stream=replace(ASKING, exits=4, kept=4), learning=replace(LEARNING, spread=8, coarse_steps=0)
    ),
    "8 walks a query": stream(exits=8, kept=8),
    "64 walks a query at most": stream(exits=64),
    "32 walks a query, each a ray": stream(least_exits=32, kept=32),
    "6 rays a query": stream(kept=6),
    "no coarse steps": learning(coarse_steps=0),
    "3000 coarse steps": learning(coarse_steps=3000),
    "8 directions besides the exits": learning(spread=8),
    "48 directions besides the exits": learning(spread=48),
    "1 walk a value": stream(walks=1),
    "4 walks a value": stream(walks=4),
}


class Truth:
    """Path-traced answers that all variants are compared with: Ŝ where it has values, and a_lm."""

    def __init__(self, scene: Scene) -> None:
        """Path trace them."""
        prepared = prepare(scene)
        self._values = hold_out(prepared, QUERIES, 8, WALKS, SEED) if smooth_part(scene) is None else None
        self._coefficients = hold_out_coefficients(scene, QUERIES, 8 * WALKS, SEED, directions=256)
        positions, outgoing = vertex_views(prepared, VERTICES, VIEWS, SEED).flat()
        seen = estimate_coefficients(scene, positions, outgoing, 2, 8 * WALKS, SEED + 2)
        self._vertices = HeldOutCoefficients(positions, outgoing, seen.mean, seen.standard_error, directions=256)

    def errors(self, network: NeuralBSSRDF) -> dict[str, float | None]:
        """The relative RMSE of a network."""
        return {
            "transport": None if self._values is None else self._values.relative_rmse(network),
            "coefficients": self._coefficients.relative_rmse(network),
            "vertices": self._vertices.relative_rmse(network),
        }


def trained(scene: Scene, variant: Variant, minutes: float, truth: Truth) -> dict[str, Any]:
    """The figures of one training."""
    found = train(
        scene,
        minutes=minutes,
        settings=variant.network,
        stream=variant.stream,
        learning=variant.learning,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.pt"
        save_model(found, path)
        size = path.stat().st_size / 1024
    training = found.metadata["training"]
    return {**truth.errors(found.on(scene.mesh)), "walks": training["walks"], "steps": training["steps"], "kib": size}


def main() -> None:
    """Train every variant and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=SHIPPED / "spot.toml")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    scene = read_scene(asked.scene)
    truth = Truth(scene)
    head = f"{'variant':36}{'error of S':>11}{'of a_lm':>9}{'vertices':>10}{'walks':>12}{'steps':>8}{'KiB':>6}"
    print(f"{head}   ({asked.minutes:g} minutes)")
    rows = {}
    for name, variant in VARIANTS.items():
        if asked.only and not any(word in name for word in asked.only):
            continue
        row = rows[name] = trained(scene, variant, asked.minutes, truth)
        transport = "" if row["transport"] is None else f"{row['transport']:.4f}"
        print(
            f"{name:36}{transport:>11}{row['coefficients']:9.4f}{row['vertices']:10.4f}"
            f"{row['walks']:12,}{row['steps']:8,}{row['kib']:6.0f}",
            flush=True,
        )
        if asked.out is not None:
            asked.out.parent.mkdir(parents=True, exist_ok=True)
            asked.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
