"""Fits an importance module to a trained network: evaluates its targets once, then minimises the KL divergence.

The optimiser is Adam with a cosine decay of the learning rate over the steps or the time, whichever ends first.
"""

import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from bakers.transport import on_mesh, refuse_foreign
from formats.mesh import Mesh
from prt_bake.importance.loss import TargetTensors, assess, assess_constant, density, divergence, uniform_fitness
from prt_bake.importance.module import ImportanceModule, ImportanceSettings
from prt_bake.importance.targets import DIRECTIONS, QUERIES_PER_BLOCK, gather_targets

STEPS = 1500
BLOCKS = 16
"""Blocks of 256 queries for training."""
VALIDATION_BLOCKS = 1
QUERIES_PER_STEP = 256
STRIDE = 8
"""A step uses every eighth direction of a query, with a random offset."""
LEARNING_RATE = 4e-3
GATHERING_SHARE = 0.5
"""Share of the time after which the evaluation of targets stops."""

Progress = Callable[[float, str], None]
"""progress(share done in [0, 1], message); a KeyboardInterrupt from it ends the fit early, without loss."""


def _silent(share: float, message: str) -> None:
    pass


class Clock:
    """The time limit of a fit, and its progress callback."""

    def __init__(self, seconds: float = math.inf, progress: Progress = _silent) -> None:
        self.began, self.seconds, self.progress = time.monotonic(), seconds, progress

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.began

    @property
    def used(self) -> float:
        """The share of the time that has passed."""
        return self.elapsed / self.seconds if self.seconds > 0.0 else 1.0


def fit_importance(
    network: Any,
    mesh: Mesh,
    *,
    seconds: float = 60.0,
    seed: int = 0,
    progress: Progress | None = None,
    settings: ImportanceSettings | None = None,
    steps: int | None = None,
    blocks: int = BLOCKS,
    device: str = "cpu",
    threads: int | None = None,
) -> ImportanceModule:
    """An importance module for `network` (any transport with values of Ŝ) on its mesh, ready to be saved.

    The fit ends after `seconds` or STEPS steps, whichever comes first. With `steps` it ends after these, independent of
    the time, and the same seed gives the same module bit by bit. It trains on `blocks` times 256 queries and validates
    on 256 others. `.metadata["fit"]` holds the divergence and variance (`prt_bake.importance.loss.Fitness`) of uniform
    directions, of the best constant σ and of the module. Raises ModelError if the network is black or not finite on the
    mesh, QueryError if the network was trained on another mesh.
    """
    refuse_foreign(network, mesh)
    clock = Clock(math.inf if steps else seconds, progress or _silent)
    bound = on_mesh(network, mesh)
    transport = bound.prepared(device=device) if hasattr(bound, "prepared") else bound
    torch_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        validation, training = gather(
            transport, mesh, blocks, seed, threads=threads or os.cpu_count() or 1, clock=clock, device=device
        )
        low, high = np.asarray(mesh.bounds, np.float64)
        chosen = settings or ImportanceSettings(seed=seed)
        module = ImportanceModule(chosen, low, float((high - low).max())).to(device)
        constant = best_constant(chosen, training)
        module.start_at(constant)
        done = descend(module, training, steps or STEPS, seed, clock)
        module.round_as_stored()
        module.metadata["fit"] = {
            "seed": seed,
            "queries": len(training),
            "steps": done,
            "seconds": round(clock.elapsed, 1),
            "uniform": asdict(uniform_fitness(validation)),
            "constant sigma": constant,
            "constant": asdict(assess_constant(constant, chosen.shape, chosen.uniform_share, validation)),
            "module": asdict(assess(module, validation)),
        }
    finally:
        torch.set_num_threads(torch_threads)
    return module.cpu().eval()


def gather(
    transport: Any,
    mesh: Mesh,
    blocks: int,
    seed: int,
    *,
    threads: int = 1,
    clock: Clock | None = None,
    device: str = "cpu",
) -> tuple[TargetTensors, TargetTensors]:
    """Targets for validation (a block) and for training: `blocks` of 256 queries, fewer if half the time has passed."""
    timer = clock or Clock()

    def follow(done: int) -> bool:
        try:
            timer.progress(
                0.3 * done / (blocks + 1), f"{done * QUERIES_PER_BLOCK:,} queries of {DIRECTIONS} directions"
            )
        except KeyboardInterrupt:  # those gathered so far give a module
            return False
        return timer.used < GATHERING_SHARE

    validation = gather_targets(transport, mesh, range(VALIDATION_BLOCKS), seed)
    numbers = range(VALIDATION_BLOCKS, VALIDATION_BLOCKS + blocks)
    training = gather_targets(transport, mesh, numbers, seed, threads=threads, follow=follow)
    return TargetTensors.of(validation, device), TargetTensors.of(training, device)


def descend(module: ImportanceModule, targets: TargetTensors, steps: int, seed: int, clock: Clock | None = None) -> int:
    """Minimises the divergence in at most `steps` steps, or until the time is up; returns the number of steps taken."""
    clock = clock or Clock()
    random = np.random.default_rng([seed, 0x1B2])
    optimiser = torch.optim.Adam(module.parameters(), lr=LEARNING_RATE)
    start = min(clock.used, 1.0)
    average, step = 0.0, 0
    try:
        for step in range(1, steps + 1):
            share = max((step - 1) / steps, (clock.used - start) / max(1.0 - start, 1e-9) if start < 1.0 else 1.0)
            if share >= 1.0:
                return step - 1
            optimiser.param_groups[0]["lr"] = LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * share))
            rows = torch.from_numpy(random.integers(0, len(targets), QUERIES_PER_STEP)).to(targets.turn.device)
            bins = slice(int(random.integers(STRIDE)), None, STRIDE)
            part = targets.share[rows, bins]
            part = part / part.sum(dim=1, keepdim=True).clamp_min(1e-30)
            loss = divergence(part, density(module, targets, rows, bins)).mean()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
            value = float(loss.detach())
            average = value if step == 1 else 0.95 * average + 0.05 * value
            clock.progress(0.3 + 0.7 * share, f"step {step}, KL divergence {average:.4f}")
    except KeyboardInterrupt:
        return step
    return step


def best_constant(settings: ImportanceSettings, targets: TargetTensors) -> float:
    """The σ of one lobe about the normal, equal for the whole object, with the least divergence on the first block."""
    block = targets.first(QUERIES_PER_BLOCK)
    fits = {
        float(sigma): assess_constant(float(sigma), settings.shape, settings.uniform_share, block).divergence
        for sigma in np.geomspace(0.1, 4.0, 24).round(3)
    }
    return min(fits, key=lambda sigma: fits[sigma])
