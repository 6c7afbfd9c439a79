"""Fits an importance module to a trained network: gather its values once, then lower the KL divergence.

Adam with a cosine decay over what there is of steps or of time, whichever ends first.
"""

import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from formats.mesh import Mesh
from prt_bake.importance import ImportanceModule, ImportanceSettings
from prt_bake.importance_loss import (
    Fitness,
    TargetTensors,
    assess,
    assess_constant,
    density,
    divergence,
    uniform_fitness,
)
from prt_bake.importance_targets import DIRECTIONS, QUERIES_PER_BLOCK, gather_targets

STEPS = 1500
BLOCKS = 16
"""Of 256 queries, to learn from."""
VALIDATION_BLOCKS = 1
QUERIES_PER_STEP = 128
STRIDE = 4
"""Every fourth direction of a query in a step, another quarter in each."""
LEARNING_RATE = 2e-3
GATHERING_SHARE = 0.5
"""Of the time: gathering stops there, with what it has."""

Progress = Callable[[float, str], None]
"""progress(share done in [0, 1], a few words); may raise KeyboardInterrupt to end the fit with what is learnt."""


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
    """An importance module for `network` (anything with `evaluate_block`) on its mesh, ready to be saved.

    It ends after `seconds`, or after `steps` if they are given: then nothing depends on the clock, and the same seed
    gives the same module bit by bit. Learns from `blocks` times 256 queries; what it reached on 256 others stands in
    `.metadata["fit"]`: divergence and variance (`prt_bake.importance_loss.Fitness`) of uniform directions, of the best
    single σ for the object and of the module. Raises ModelError if the network is black or not finite on the mesh.
    """
    clock = _Clock(math.inf if steps else seconds, progress or (lambda share, words: None))
    transport = network.prepared(device=device) if hasattr(network, "prepared") else network
    inner = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        held, taught = _gather(transport, mesh, blocks, seed, threads or os.cpu_count() or 1, clock, device)
        low, high = np.asarray(mesh.bounds, np.float64)
        chosen = settings or ImportanceSettings(seed=seed)
        module = ImportanceModule(chosen, low, float((high - low).max())).to(device)
        done = _descend(module, taught, steps or STEPS, seed, clock)
        constant, best = _best_constant(chosen, held)
        module.metadata["fit"] = {
            "seed": seed,
            "queries": len(taught),
            "steps": done,
            "seconds": round(clock.elapsed, 1),
            "uniform": asdict(uniform_fitness(held)),
            "constant sigma": constant,
            "constant": asdict(best),
            "module": asdict(assess(module, held)),
        }
    finally:
        torch.set_num_threads(inner)
    return module.cpu().eval()


class _Clock:
    """How much of the time is used up."""

    def __init__(self, seconds: float, progress: Progress) -> None:
        self.began, self.seconds, self.progress = time.monotonic(), seconds, progress

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.began

    @property
    def used(self) -> float:
        return self.elapsed / self.seconds if self.seconds > 0.0 else 1.0


def _gather(
    transport: Any, mesh: Mesh, blocks: int, seed: int, threads: int, clock: _Clock, device: str
) -> tuple[TargetTensors, TargetTensors]:
    """Targets held back, and targets to learn from."""

    def follow(done: int) -> bool:
        clock.progress(0.3 * done / (blocks + 1), f"{done * QUERIES_PER_BLOCK:,} queries of {DIRECTIONS} directions")
        return clock.used < GATHERING_SHARE

    held = gather_targets(transport, mesh, range(VALIDATION_BLOCKS), seed)
    numbers = range(VALIDATION_BLOCKS, VALIDATION_BLOCKS + blocks)
    taught = gather_targets(transport, mesh, numbers, seed, threads=threads, follow=follow)
    return TargetTensors.of(held, device), TargetTensors.of(taught, device)


def _descend(module: ImportanceModule, targets: TargetTensors, steps: int, seed: int, clock: _Clock) -> int:
    """Lowers the divergence; returns how many steps were taken."""
    random = np.random.default_rng([seed, 0x1B2])
    optimiser = torch.optim.Adam(module.parameters(), lr=LEARNING_RATE)
    began = min(clock.used, 1.0)
    shown, step = 0.0, 0
    try:
        for step in range(1, steps + 1):
            share = max((step - 1) / steps, (clock.used - began) / max(1.0 - began, 1e-9) if began < 1.0 else 1.0)
            if share >= 1.0:
                return step - 1
            optimiser.param_groups[0]["lr"] = LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * share))
            rows = torch.from_numpy(random.integers(0, len(targets), QUERIES_PER_STEP)).to(targets.turn.device)
            bins = slice(int(random.integers(STRIDE)), None, STRIDE)
            part = targets.share[rows, bins]
            part = part / part.sum(dim=1, keepdim=True).clamp_min(1e-30)
            loss = divergence(part, density(module, targets, rows, bins)).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            shown = float(loss.detach()) if step == 1 else 0.95 * shown + 0.05 * float(loss.detach())
            clock.progress(0.3 + 0.7 * share, f"step {step}, KL divergence {shown:.4f}")
    except KeyboardInterrupt:
        return step
    return step


def _best_constant(settings: ImportanceSettings, targets: TargetTensors) -> tuple[float, Fitness]:
    """The σ of one lobe about the normal that suits the whole object best, and how well."""
    found = {
        float(sigma): assess_constant(float(sigma), settings.shape, settings.uniform_share, targets)
        for sigma in np.geomspace(0.1, 4.0, 24).round(3)
    }
    best = min(found, key=lambda sigma: found[sigma].divergence)
    return best, found[best]
