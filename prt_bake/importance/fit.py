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

from bakers.transport import on_mesh, refuse_foreign
from formats.mesh import Mesh
from prt_bake.importance.loss import TargetTensors, assess, assess_constant, density, divergence, uniform_fitness
from prt_bake.importance.module import ImportanceModule, ImportanceSettings
from prt_bake.importance.targets import DIRECTIONS, QUERIES_PER_BLOCK, BlockTransport, gather_targets

STEPS = 1500
BLOCKS = 16
"""Of 256 queries, to learn from."""
VALIDATION_BLOCKS = 1
QUERIES_PER_STEP = 256
STRIDE = 8
"""Every eighth direction of a query in a step, other ones in each."""
LEARNING_RATE = 4e-3
GATHERING_SHARE = 0.5
"""Of the time: gathering stops there, with what it has."""

Progress = Callable[[float, str], None]
"""progress(share done in [0, 1], a few words); a KeyboardInterrupt from it ends the fit with what is learnt."""


def _silent(share: float, words: str) -> None:
    pass


class Clock:
    """How much of the time is used up, and whom to tell."""

    def __init__(self, seconds: float = math.inf, progress: Progress = _silent) -> None:
        self.began, self.seconds, self.progress = time.monotonic(), seconds, progress

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self.began

    @property
    def used(self) -> float:
        """The share of the time that is up."""
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
    """An importance module for `network` (anything with `evaluate_block`) on its mesh, ready to be saved.

    It ends after `seconds`, or before, after STEPS; or after `steps` if they are given: then nothing depends on the
    clock, and the same seed gives the same module bit by bit. Learns from `blocks` times 256 queries; what it reached
    on 256 others stands in `.metadata["fit"]`: divergence and variance (`prt_bake.importance.loss.Fitness`) of uniform
    directions, of the best single σ for the object and of the module. Raises ModelError if the network is black or not
    finite on the mesh, QueryError if the mesh is not the network's own.
    """
    refuse_foreign(network, mesh)
    clock = Clock(math.inf if steps else seconds, progress or _silent)
    bound = on_mesh(network, mesh)
    transport = bound.prepared(device=device) if hasattr(bound, "prepared") else bound
    inner = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        held, taught = gather(
            transport, mesh, blocks, seed, threads=threads or os.cpu_count() or 1, clock=clock, device=device
        )
        low, high = np.asarray(mesh.bounds, np.float64)
        chosen = settings or ImportanceSettings(seed=seed)
        module = ImportanceModule(chosen, low, float((high - low).max())).to(device)
        constant = best_constant(chosen, taught)
        module.start_at(constant)
        done = descend(module, taught, steps or STEPS, seed, clock)
        module.round_as_stored()
        module.metadata["fit"] = {
            "seed": seed,
            "queries": len(taught),
            "steps": done,
            "seconds": round(clock.elapsed, 1),
            "uniform": asdict(uniform_fitness(held)),
            "constant sigma": constant,
            "constant": asdict(assess_constant(constant, chosen.shape, chosen.uniform_share, held)),
            "module": asdict(assess(module, held)),
        }
    finally:
        torch.set_num_threads(inner)
    return module.cpu().eval()


def gather(
    transport: BlockTransport,
    mesh: Mesh,
    blocks: int,
    seed: int,
    *,
    threads: int = 1,
    clock: Clock | None = None,
    device: str = "cpu",
) -> tuple[TargetTensors, TargetTensors]:
    """Targets held back (a block), and targets to learn from: `blocks` of 256 queries, fewer if half the time is up."""
    timer = clock or Clock()

    def follow(done: int) -> bool:
        timer.progress(0.3 * done / (blocks + 1), f"{done * QUERIES_PER_BLOCK:,} queries of {DIRECTIONS} directions")
        return timer.used < GATHERING_SHARE

    held = gather_targets(transport, mesh, range(VALIDATION_BLOCKS), seed)
    numbers = range(VALIDATION_BLOCKS, VALIDATION_BLOCKS + blocks)
    taught = gather_targets(transport, mesh, numbers, seed, threads=threads, follow=follow)
    return TargetTensors.of(held, device), TargetTensors.of(taught, device)


def descend(module: ImportanceModule, targets: TargetTensors, steps: int, seed: int, clock: Clock | None = None) -> int:
    """Lowers the divergence by at most `steps` steps, or until the clock's time is up; returns how many were taken."""
    clock = clock or Clock()
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
            torch.autograd.backward(loss)
            optimiser.step()
            shown = float(loss.detach()) if step == 1 else 0.95 * shown + 0.05 * float(loss.detach())
            clock.progress(0.3 + 0.7 * share, f"step {step}, KL divergence {shown:.4f}")
    except KeyboardInterrupt:
        return step
    return step


def best_constant(settings: ImportanceSettings, targets: TargetTensors) -> float:
    """The σ of one lobe about the normal that suits the whole object best, by the first block of its targets."""
    few = targets.first(QUERIES_PER_BLOCK)
    fits = {
        float(sigma): assess_constant(float(sigma), settings.shape, settings.uniform_share, few).divergence
        for sigma in np.geomspace(0.1, 4.0, 24).round(3)
    }
    return min(fits, key=lambda sigma: fits[sigma])
