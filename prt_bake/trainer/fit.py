"""`train`: a renderer and a learner side by side, until the time or the steps are used up.

Loss: squared error (the paper's L2) of Ŝ in units of the network's output scale. Adam, a rate that falls along a
cosine to zero, and matrix work in bfloat16 with float32 weights where the processor has it.
"""

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from formats.errors import QueryError, SceneError
from formats.scene import Scene
from prt_bake.network import PRESETS, NetworkSettings, NeuralBSSRDF, save_model
from prt_bake.trainer.prepared import PreparedScene, prepare, smooth_part
from prt_bake.trainer.resume import read_state, write_state
from prt_bake.trainer.stream import Renderer, StreamSettings
from prt_bake.trainer.validation import VALIDATION_SEED, HeldOut, final_figures, hold_out


@dataclass(frozen=True)
class LearningSettings:
    """How the learner learns; chosen by measured error after equal time (`make bench`)."""

    batch: int = 4096
    rate: float = 2e-3
    warm_up: float = 0.02
    """Share of the run over which the rate rises."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints."""
    report_every: float = 2.0
    bfloat16: bool = True
    held_out_queries: int = 512
    held_out_walks: int = 256


@dataclass(frozen=True)
class TrainingRow:
    """One line of progress. `share` runs from 0 to 1; `validation` is the relative RMSE of Ŝ on held-out queries."""

    seconds: float
    step: int
    share: float
    loss: float
    validation: float
    values_per_second: float
    walks_per_second: float


Progress = Callable[[TrainingRow], None]


def train(
    scene: Scene,
    *,
    minutes: float = 10.0,
    steps: int | None = None,
    seed: int = 0,
    settings: NetworkSettings | None = None,
    device: str = "cpu",
    output: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
    stream: StreamSettings | None = None,
    learning: LearningSettings | None = None,
) -> NeuralBSSRDF:
    """Train a neural BSSRDF of a scene for `minutes`, or for `steps` where given, and return it with its final figures.

    `settings` are those of the preset "measured" unless given; `PRESETS["paper"]` is the paper's network.
    `steps` counts from the very beginning, resumed or not. `say` is told what goes on before and after the learning.
    The figures (relative RMSE of Ŝ and of a_lm on fresh queries, reference noise taken out) stand in
    `network.metadata["training"]`. With `output` the model is written there once a minute and at the end, beside it
    what `resume` needs. A KeyboardInterrupt ends the training early and keeps what was learnt.

    Raises SceneError for a smooth interface (Ŝ has no point values there), QueryError for a time that is not positive.
    """
    smooth = smooth_part(scene)
    if smooth is not None:
        raise SceneError(
            f"{scene.path}: the boundary of '{smooth.name}' is smooth: training behind a smooth interface is "
            "not supported yet; give it a small roughness such as 0.05"
        )
    if minutes <= 0 or (steps is not None and steps < 1):
        raise QueryError(f"train: minutes {minutes:g} and steps {steps} where positive ones are expected")
    tell = say or (lambda sentence: None)
    tell("path tracing the queries that the training is measured by")
    run = _Run(
        scene, settings or PRESETS["measured"], seed, device, stream or StreamSettings(), learning or LearningSettings()
    )
    if resume:
        if output is None:
            raise QueryError("train: resume needs the output that it goes on from")
        run.restore(read_state(output, scene.content_hash))
    run.learn(minutes * 60.0, steps, output, progress)
    tell("path tracing fresh queries for the final figures")
    return run.finish(output)


class _Run:
    """One training run: the network, its optimiser, and how far it has come."""

    def __init__(
        self,
        scene: Scene,
        settings: NetworkSettings,
        seed: int,
        device: str,
        stream: StreamSettings,
        learning: LearningSettings,
    ) -> None:
        self.scene, self.seed, self.device = scene, seed, torch.device(device)
        self.stream, self.learning = stream, learning
        self.prepared: PreparedScene = prepare(scene)
        low, high = scene.mesh.positions.min(axis=0), scene.mesh.positions.max(axis=0)
        self.held_out: HeldOut = hold_out(
            self.prepared, learning.held_out_queries, 8, learning.held_out_walks, VALIDATION_SEED
        )
        scale = float(np.sqrt(np.mean(self.held_out.mean**2)))
        self.network = NeuralBSSRDF(settings, low, float((high - low).max()), scale or 1.0, _metadata(scene)).to(
            self.device
        )
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=learning.rate, betas=(0.9, 0.99))
        self.step, self.seconds, self.walks, self.next_query, self.next_draw = 0, 0.0, 0, 0, 0
        self.history: list[TrainingRow] = []

    def restore(self, state: dict[str, Any]) -> None:
        """Take up where a checkpoint left off."""
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step, self.seconds = int(state["step"]), float(state["seconds"])
        self.walks, self.next_query, self.next_draw = int(state["walks"]), int(state["next_query"]), self.step
        self.history = [TrainingRow(**row) for row in state["history"]]

    def state(self) -> dict[str, Any]:
        """What `restore` needs, plain values and tensors."""
        return {
            "scene": self.scene.content_hash,
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "walks": self.walks,
            "next_query": self.next_query,
            "history": [asdict(row) for row in self.history],
        }

    def learn(self, seconds: float, steps: int | None, output: str | Path | None, progress: Progress | None) -> None:
        """Run renderer and learner until the time or the steps are used up, or until Ctrl-C."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        walkers = cores if self.device.type != "cpu" else max(1, cores - 1)
        renderer = Renderer(
            self.prepared,
            self.network.box_min.cpu().numpy(),
            self.network.box_side,
            self.stream,
            self.seed,
            self.next_query,
            walkers,
        )
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            renderer.start(min(16 * self.learning.batch, self.stream.capacity))
            self._learn(renderer, seconds, steps, output, progress)
        except KeyboardInterrupt:
            pass
        finally:
            renderer.stop()
            torch.set_num_threads(threads)

    def _learn(
        self,
        renderer: Renderer,
        seconds: float,
        steps: int | None,
        output: str | Path | None,
        progress: Progress | None,
    ) -> None:
        generator = np.random.default_rng((self.seed, self.next_draw))
        before, walked = self.seconds, self.walks
        begun = reported = saved = time.perf_counter()
        loss_sum, loss_count = 0.0, 0
        while True:
            share = self.step / steps if steps is not None else self.seconds / seconds
            if share >= 1.0:
                break
            self._set_rate(share)
            loss_sum += self._step(renderer.buffer.draw(self.learning.batch, generator))
            loss_count += 1
            self.step += 1
            now = time.perf_counter()
            self.seconds = before + now - begun
            self.walks, self.next_query = walked + renderer.walks, renderer.next_query
            if now - reported > self.learning.report_every:
                renderer.check()
                self._report(
                    progress,
                    share,
                    loss_sum / loss_count,
                    loss_count / (now - reported),
                    renderer.walks / (now - begun),
                )
                reported, loss_sum, loss_count = time.perf_counter(), 0.0, 0
            if output is not None and now - saved > self.learning.checkpoint_every:
                self.save(output)
                saved = time.perf_counter()

    def _set_rate(self, share: float) -> None:
        rise = min(1.0, (share + 1e-4) / self.learning.warm_up)
        rate = float(self.learning.rate * rise * 0.5 * (1.0 + np.cos(np.pi * min(1.0, share))))
        for group in self.optimizer.param_groups:
            group["lr"] = rate

    def _step(self, rows: Any) -> float:
        batch = torch.from_numpy(rows).to(self.device)
        network = self.network
        positions = network.box_min + network.box_side * batch[:, 3:6].double()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.learning.bfloat16):
            answer = network(batch[:, 0:3], positions, batch[:, 6:9])
        loss = torch.mean(((answer.float() - batch[:, 9:12]) / network.output_scale) ** 2)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        value = float(loss.detach())
        if not np.isfinite(value):
            raise QueryError(f"train: the loss of step {self.step} is {value}; lower the rate ({self.learning.rate:g})")
        return value

    def _report(
        self, progress: Progress | None, share: float, loss: float, steps_per_second: float, walks: float
    ) -> None:
        row = TrainingRow(
            seconds=self.seconds,
            step=self.step,
            share=share,
            loss=loss,
            validation=self.held_out.relative_rmse(self.network),
            values_per_second=steps_per_second * self.learning.batch,
            walks_per_second=walks,
        )
        self.history.append(row)
        if progress is not None:
            progress(row)

    def save(self, output: str | Path) -> None:
        """Write the model, and beside it what `resume` needs."""
        save_model(self.network, output)
        write_state(output, self.state())

    def finish(self, output: str | Path | None) -> NeuralBSSRDF:
        """Measure the final figures, note them in the model and write it."""
        self.network.eval()
        figures = final_figures(
            self.network, self.scene, self.prepared, self.learning.held_out_queries, self.learning.held_out_walks
        )
        self.network.metadata["training"] = {
            "seconds": self.seconds,
            "steps": self.step,
            "walks": self.walks,
            "seed": self.seed,
            "stream": asdict(self.stream),
            "learning": asdict(self.learning),
            "relative_rmse": figures.as_json(),
            "validation_vs_time": [
                [row.seconds, row.walks_per_second * row.seconds, row.validation] for row in self.history[::10]
            ],
        }
        if output is not None:
            self.save(output)
        return self.network


def _metadata(scene: Scene) -> dict[str, Any]:
    return {
        "scene": Path(scene.path).name,
        "scene_hash": scene.content_hash,
        "up": scene.up,
        "unit": scene.unit,
        "eta": float(scene.eta),
        "roughness": float(np.mean(scene.roughness)),
    }
