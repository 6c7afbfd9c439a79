"""Prints what a GPU does for the path tracer and the trainer: python -m tests.on_gpu [--minutes 1] (`make gpu`)."""

import argparse
import time
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from prt_bake.tracer.gpu.availability import reason_against
from prt_bake.trainer.history import TrainingProgress
from prt_bake.trainer.train import train
from prt_bake.trainer.validation import hold_out_coefficients
from tests.on_gpu import walks

MOST_DIFFERENT, ROUNDING = 1e-3, 1e-6
LARGEST_MEAN_SQUARE, LARGEST_Z = 1.25, 6.0
"""Of some 3,400 z-scores, those of a query from the same walks: right walks exceed them once in 10⁵ runs."""
TRAINED = "dragon's stand-in"


def main() -> None:
    """Print the tables of walks, then those of a training."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="of the training")
    minutes = parser.parse_args().minutes
    if reason := reason_against():
        raise SystemExit(f"prtbake: walks cannot run on a GPU here: {reason}")
    begun = time.perf_counter()
    print(torch.cuda.get_device_name())
    faults = print_walks()
    print_training(minutes)
    print(f"{time.perf_counter() - begun:.0f} s in all")
    if faults:
        raise SystemExit("\n".join(faults))


def print_walks() -> list[str]:
    """One row for each scene; returns what is wrong."""
    faults = []
    print("| scene | M walks/s | one core, k | ratio | walks that differ | mean throughput | z² | largest z |")
    print("|---|---|---|---|---|---|---|---|")
    for name in walks.SCENES:
        scene = walks.load(name)
        gpu, core = walks.walks_per_second(scene), walks.core_walks_per_second(scene)
        share, mean = walks.different_walks(scene)
        square, largest, count = walks.z_scores(scene)
        print(
            f"| {name} | {gpu / 1e6:.1f} | {core / 1e3:.0f} | {gpu / core:.0f} | {share:.1e} | {mean:+.1e} | "
            f"{square:.3f} | {largest:.1f} of {count} |",
            flush=True,
        )
        if share > MOST_DIFFERENT or square > LARGEST_MEAN_SQUARE or largest > LARGEST_Z:
            faults.append(f"{name}: the walks of the GPU are not those of the processor")
    deviation = walks.furnace(walks.load("spot, index-matched"))
    print(f"white furnace: the throughput of walks that leave differs from 1 by up to {deviation:.1e}")
    return faults + ([] if deviation < ROUNDING else ["white furnace: walks lose or gain light"])


def print_training(minutes: float) -> None:
    """Progress and final error of a training of `minutes`."""
    scene = walks.load(TRAINED)

    def show(row: TrainingProgress) -> None:
        if row.step and round(row.seconds) % 10 < 3:
            print(
                f"{row.seconds:5.0f} s, step {row.step}, {row.walks_per_second / 1e6:.1f} M walks/s, a_lm "
                f"{row.validation:.2%}, the GPU is busy for {busy()} of the time",
                flush=True,
            )

    with TemporaryDirectory() as folder:
        network = train(scene, minutes=minutes, device="cuda", output=Path(folder) / "m.pt", progress=show, say=print)
    training = network.metadata["training"]
    error = hold_out_coefficients(scene, 1000, 32768, 4242, 512, "cuda").relative_rmse(network)
    rate = training["walks"] / training["seconds"]
    print(f"{TRAINED}: {training['walks'] / 1e6:.0f} M walks, {training['steps']} steps, a_lm {error:.2%};")
    print(f"ten minutes would give {600.0 * rate / 1e9:.2f} G walks")


def busy() -> str:
    """How busy the GPU's driver says that it is."""
    return f"{torch.cuda.utilization()} %" if find_spec("pynvml") is not None else "unknown"


if __name__ == "__main__":
    main()
