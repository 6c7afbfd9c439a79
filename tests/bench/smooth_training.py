"""Training behind a smooth interface (from exits) compared with slightly rough ones (from exits and from values).

    python -m tests.bench.smooth_training [--steps 1000] [--scene SCENE.toml] [--eta 1.4] [--seeds 2]

The shipped scene with other interfaces, in synchronous runs of equal steps. Prints the relative RMSE of a_lm on fresh
queries, corrected for the reference's noise, as mean and half the range over the seeds; the walks; and CPU seconds.
"""

import argparse
import re
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from formats.scene import Scene, read_scene
from prt_bake.shipped.demonstration import SHIPPED
from prt_bake.trainer.samples.rows import StreamSettings
from prt_bake.trainer.train import LearningSettings, TrainingProgress, train

VARIANTS: dict[str, tuple[float, StreamSettings]] = {
    "smooth, exits": (0.0, StreamSettings()),
    "alpha 0.05, exits": (0.05, StreamSettings()),
    "alpha 0.05, values": (0.05, StreamSettings(rays="values")),
    "alpha 0.2, exits": (0.2, StreamSettings()),
    "alpha 0.2, values": (0.2, StreamSettings(rays="values")),
}


def with_interface(source: Path, folder: Path, eta: float, alpha: float) -> Scene:
    """The scene with another interface, copied into `folder`."""
    shutil.copytree(source.parent, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    text = re.sub(r"(?ms)^\[interface\].*?(?=^\[|\Z)", "", source.read_text(encoding="utf-8"))
    text += f"\n[interface]\neta = {eta}\nroughness = {alpha}\n"
    (folder / source.name).write_text(text, encoding="utf-8")
    return read_scene(folder / source.name)


def learn(scene: Scene, stream: StreamSettings, steps: int, seed: int) -> tuple[float, int, float]:
    """Error of a_lm, walks, and CPU seconds of path tracing and learning."""
    begun, ended = time.process_time(), 0.0

    def follow(_report: TrainingProgress) -> None:
        nonlocal ended
        ended = time.process_time()

    learning = LearningSettings(report_every=20.0, held_out_queries=256)
    network = train(scene, steps=steps, seed=seed, synchronous=True, stream=stream, learning=learning, progress=follow)
    training = network.metadata["training"]
    return training["relative_rmse"]["coefficients"], training["walks"], ended - begun


def main() -> None:
    """Train every variant and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--scene", type=Path, default=SHIPPED / "spot.toml")
    parser.add_argument("--eta", type=float, default=1.4)
    parser.add_argument("--seeds", type=int, default=2)
    args = parser.parse_args()
    print(f"{'variant':20} {'error of a_lm':>15} {'walks':>10} {'CPU s':>7}   ({args.steps} steps)", flush=True)
    for name, (alpha, stream) in VARIANTS.items():
        with tempfile.TemporaryDirectory() as folder:
            scene = with_interface(args.scene, Path(folder), args.eta, alpha)
            found = np.array([learn(scene, stream, args.steps, seed) for seed in range(args.seeds)])
        error = found[:, 0]
        print(
            f"{name:20} {error.mean():8.4f} ±{np.ptp(error) / 2:6.4f} {found[0, 1]:10,.0f} {found[:, 2].mean():7.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
