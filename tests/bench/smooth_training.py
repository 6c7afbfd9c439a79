"""Training behind a smooth interface against slightly rough ones.

    python tests/bench/smooth_training.py [--steps 1000] [--scene SCENE.toml] [--eta 1.4]

The shipped scene with its interface exchanged, equal steps in turns. Prints the relative RMSE of a_lm on fresh queries
(the reference's noise taken out), the walks, and CPU seconds. A step learns from 512 queries: of 4 exits each, or of
values in 8 directions each, from one walk or from 4.
"""

import argparse
import re
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from formats.scene import Scene, read_scene
from prt_bake.demonstration import SHIPPED
from prt_bake.trainer.fit import LearningSettings, train
from prt_bake.trainer.rows import StreamSettings

VARIANTS: dict[str, tuple[float, StreamSettings, LearningSettings]] = {
    "smooth, exits": (0.0, StreamSettings(), LearningSettings()),
    "smooth, exits, 2 directions besides": (0.0, StreamSettings(), LearningSettings(spread=2)),
    "smooth, each query learnt from twice": (0.0, StreamSettings(reuse=2), LearningSettings()),
    "alpha 0.05, exits": (0.05, StreamSettings(), LearningSettings()),
    "alpha 0.05, values": (0.05, StreamSettings(rays="values", walks=1), LearningSettings()),
    "alpha 0.05, values of 4 walks": (0.05, StreamSettings(rays="values", walks=4), LearningSettings()),
    "alpha 0.2, exits": (0.2, StreamSettings(), LearningSettings()),
    "alpha 0.2, values": (0.2, StreamSettings(rays="values", walks=1), LearningSettings()),
}


def with_interface(source: Path, folder: Path, eta: float, alpha: float) -> Scene:
    """The scene with another interface, copied into `folder`."""
    shutil.copytree(source.parent, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    text = re.sub(r"(?ms)^\[interface\].*?(?=^\[|\Z)", "", source.read_text(encoding="utf-8"))
    text += f"\n[interface]\neta = {eta}\nroughness = {alpha}\n"
    (folder / source.name).write_text(text, encoding="utf-8")
    return read_scene(folder / source.name)


def main() -> None:
    """Train every variant and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--scene", type=Path, default=SHIPPED / "spot.toml")
    parser.add_argument("--eta", type=float, default=1.4)
    asked = parser.parse_args()
    print(f"{'variant':36} {'error of a_lm':>13} {'walks':>10} {'CPU s':>7}   ({asked.steps} steps)")
    for name, (alpha, stream, learning) in VARIANTS.items():
        with tempfile.TemporaryDirectory() as folder:
            scene = with_interface(asked.scene, Path(folder), asked.eta, alpha)
            begun = time.process_time()
            seen = []
            network = train(
                scene,
                steps=asked.steps,
                synchronous=True,
                stream=stream,
                learning=replace(learning, held_out_queries=192, report_every=20.0),
                progress=lambda row, seen=seen: seen.append(time.process_time()),
            )
        figures = network.metadata["training"]
        print(
            f"{name:36} {figures['relative_rmse']['coefficients']:13.4f} {figures['walks']:10,} "
            f"{seen[-1] - begun:7.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
