"""What a training step buys: presets, walks and directions a query, at equal steps on the shipped scene.

    python tests/bench/training.py [--steps 1500]

Prints the relative RMSE of Ŝ on held-out queries (reference noise taken out), the walks and the seconds of each.
"""

import argparse
from dataclasses import replace

import numpy as np

from formats.scene import read_scene
from prt_bake.demonstration import SHIPPED
from prt_bake.network import PRESETS, NetworkSettings
from prt_bake.trainer.fit import LearningSettings, train
from prt_bake.trainer.stream import StreamSettings

MEASURED = PRESETS["measured"]
VARIANTS: dict[str, tuple[NetworkSettings, StreamSettings]] = {
    "measured preset": (MEASURED, StreamSettings()),
    "paper preset": (PRESETS["paper"], StreamSettings()),
    "spread 0.25 for all inputs": (replace(MEASURED, feature_spread=0.25, position_spread=0.25), StreamSettings()),
    "4 walks a query": (MEASURED, StreamSettings(walks=4, queries_a_batch=1024)),
    "16 directions, 4 connections": (MEASURED, StreamSettings(directions=16, connections=4)),
}


def main() -> None:
    """Train every variant and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1500)
    steps = parser.parse_args().steps
    scene = read_scene(SHIPPED / "spot.toml")
    print(f"{'variant':32} {'error of S':>10} {'of a_lm':>8} {'walks':>10} {'seconds':>8}   ({steps} steps)")
    for name, (settings, stream) in VARIANTS.items():
        learning = LearningSettings(held_out_queries=256)
        training = train(scene, steps=steps, settings=settings, stream=stream, learning=learning).metadata["training"]
        error = training["relative_rmse"]
        print(
            f"{name:32} {error['transport']:10.4f} {error['coefficients']:8.4f} "
            f"{training['walks']:10,} {np.round(training['seconds'], 1):8}",
            flush=True,
        )


if __name__ == "__main__":
    main()
