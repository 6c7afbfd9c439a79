"""Trains a NeuMIP: by the objective of the neural BSSRDF from the same walks, or by its own loss on converged values.

A step touches few texels. Their gradients are sparse, and only they are updated and averaged.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.baselines.neumip import NeuMIP
from prt_bake.baselines.neumip_settings import NeuMIPSettings
from prt_bake.baselines.texture_space import Array, Coverage, cover, dilate
from prt_bake.baselines.unwrapping import texture_coordinates
from prt_bake.network.model import TrainableModel
from prt_bake.tracer.prepared import no_values_reason
from prt_bake.trainer.fit import metadata_of
from prt_bake.trainer.learning.learner import Learner, LearningSettings, share_of_average
from prt_bake.trainer.samples.rows import CHANNELS, INCIDENT, Batch, RowSource, StreamSettings, rays_of
from prt_bake.trainer.train import train_model
from prt_bake.trainer.training_data import TrainingData

LEARNING = LearningSettings(muon=False, decay=0.0, bfloat16=False)
"""Adam alone, as published."""
CONVERGED = StreamSettings(rays="values", walks=16, reuse=8)
"""Values for its own loss, which is biased by noise: 8 times the walks of other values. Rows are reused, as the
published training does with its pictures. At an equal cost 64 walks, used 32 times, leave too few queries, and 4 walks,
used twice, too much noise (docs/explanation/baselines.md).
"""
PYRAMID = 9
"""Levels of the published pyramid, from 512² texels down to 2²."""
_L1_SHARE, _LOWEST = 0.1, -0.1
_BETAS = (0.9, 0.99)


def train_neumip(
    scene: Scene,
    *,
    settings: NeuMIPSettings | None = None,
    levels: int = 1,
    seed: int = 0,
    device: str = "cpu",
    own_loss: bool = False,
    learning: LearningSettings | None = None,
    stream: StreamSettings | None = None,
    say: Callable[[str], None] | None = None,
    **run: Any,
) -> NeuMIP:
    """Train a NeuMIP of a scene.

    Args:
        scene: the scene to path trace.
        settings: the model; by default the published size with `levels` and `seed`.
        levels: number of textures, each of half the width of the one before.
        own_loss: use the published loss, log MSE and a tenth of L1, on converged values instead of the objective of
            the neural BSSRDF.
        device: "cpu".
        seed, learning, stream, say, run: as for `prt_bake.trainer.train.train`.

    Raises QueryError for another device, and for `own_loss` behind a smooth interface, where Ŝ has no values;
    MeshError for an object that must be unwrapped, without xatlas; and what `prt.train` raises.

    >>> import prt_bake as prt
    >>> from prt_bake.baselines.neumip_training import train_neumip
    >>> model = train_neumip(prt.load_scene("spot.toml"), steps=2)
    >>> model.settings.texels
    512
    """
    refuse_path("scene", scene, "prt.load_scene")
    if device != "cpu":
        raise QueryError(f"NeuMIP: learns on the processor only; expected device 'cpu', found {device!r}")
    if own_loss and (reason := no_values_reason(scene)):
        raise QueryError(
            f"{scene.path}: {reason}; Ŝ has no values there, which the loss of neumip-log needs; train the baseline "
            "neumip"
        )
    chosen, report = settings or NeuMIPSettings(levels=levels, seed=seed), say or (lambda sentence: None)
    corner_uv = texture_coordinates(scene.mesh, chosen.texels, report)
    model = train_model(
        scene,
        lambda data, _device: NeuMIPFit(data, chosen, own_loss, corner_uv),
        seed=seed,
        device=device,
        learning=learning or LEARNING,
        stream=stream or (CONVERGED if own_loss else None),
        say=say,
        **run,
    )
    assert isinstance(model, NeuMIP)
    return model


train_neumip_log = partial(train_neumip, own_loss=True)
"""`train_neumip` with the published loss."""
train_neumip_pyramid = partial(train_neumip, levels=PYRAMID)
"""`train_neumip` with the levels of the published pyramid."""


class NeuMIPFit:
    """Fits a NeuMIP (`prt_bake.trainer.fit.Fit`)."""

    def __init__(self, data: TrainingData, settings: NeuMIPSettings, own_loss: bool, corner_uv: Array) -> None:
        """Lay out the object's texture space, from texture coordinates [F,3,2] of its faces' corners."""
        self._scene, self._settings, self._own_loss, self._corner_uv = data.scene, settings, own_loss, corner_uv
        faces = np.asarray(data.scene.mesh.faces, np.int64)
        self._coverages = [cover(self._corner_uv, faces, size) for size in settings.sizes]
        own = {f"neumip {name}": value for name, value in settings.as_json().items()}
        self.resume_settings: dict[str, Any] = {**own, "own_loss": own_loss}

    def model(self, output_scale: float) -> NeuMIP:
        """The model before its first step."""
        sizes = self._settings.sizes
        spaces = [coverage.space(self._corner_uv, size) for coverage, size in zip(self._coverages, sizes, strict=True)]
        return NeuMIP(self._settings, self._scene.mesh, spaces, output_scale, metadata_of(self._scene))

    def learner(self, model: TrainableModel, learning: LearningSettings) -> Learner:
        """Adam on the decoder and on the touched texels."""
        assert isinstance(model, NeuMIP)
        return NeuMIPLearner(model, learning, self._coverages, self._own_loss)


class NeuMIPLearner(Learner):
    """A learner that updates and averages only the texels that a step touches."""

    network: NeuMIP
    model: NeuMIP

    def __init__(
        self, network: NeuMIP, settings: LearningSettings, coverages: list[Coverage], own_loss: bool = False
    ) -> None:
        """Learn on the processor; `coverages` are those of the model's levels."""
        super().__init__(network, settings)
        self._coverages, self._own_loss = coverages, own_loss
        self._touches = torch.zeros(len(network.table), dtype=torch.int64)
        """How many steps touched each row."""

    def learn(
        self, source: RowSource, batch: Batch, share: float, generator: np.random.Generator, encoding: Any = None
    ) -> float:
        """Take one step; see `Learner.learn`."""
        value = super().learn(source, batch, share, generator, encoding)
        gradient = self.network.table.grad
        assert gradient is not None
        rows = torch.unique(gradient._indices())
        self._touches[rows] += 1
        with torch.no_grad():
            shares = share_of_average(self.settings, self._touches[rows].double()).float()[:, None]
            mean = self.model.table[rows]
            self.model.table[rows] = mean.lerp(self.network.table[rows], shares.expand_as(mean))
        return value

    def result(self) -> NeuMIP:
        """The model, with untrained texels filled from their neighbours, its weights rounded as in a file."""
        trained, start = (self._touches > 0).numpy(), 0
        with torch.no_grad():
            for space, coverage in zip(self.model.spaces, self._coverages, strict=True):
                level = slice(start, start + space.rows)
                dilate(self.model.table[level].numpy(), trained[level], coverage, space.size)
                start += space.rows
        return self.model.eval().rounded()

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return {**super().state(), "touches": self._touches}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        super().restore(state)
        self._touches = state["touches"]

    def _optimizers(self) -> list[torch.optim.Optimizer]:
        rate = self.settings.rate
        return [
            torch.optim.Adam(self.network.decoder.parameters(), lr=rate, betas=_BETAS),
            torch.optim.SparseAdam([self.network.table], lr=rate, betas=_BETAS),
        ]

    def _average(self, share: float | Tensor) -> None:
        with torch.no_grad():
            pairs = zip(self.model.decoder.parameters(), self.network.decoder.parameters(), strict=True)
            for mean, weights in pairs:
                mean.lerp_(weights, share)

    def _value_losses(self, rows: Tensor, encoding: Any) -> Tensor:
        if not self._own_loss:
            return super()._value_losses(rows, encoding)
        rays = rays_of(rows)
        predicted, _lobes = self._predict(rays[..., INCIDENT], rows, encoding)
        return own_loss(predicted, rays[..., CHANNELS] / self.network.output_scale)


def own_loss(predicted: Tensor, value: Tensor) -> Tensor:
    """The published loss [Q] of predictions and values [Q,D,3]: squared error of logarithms, and a tenth of L1."""
    logarithms = (torch.log1p(each.clamp(min=_LOWEST)) for each in (predicted, value))
    squares = (next(logarithms) - next(logarithms)) ** 2
    return torch.mean(squares + _L1_SHARE * (predicted - value).abs(), dim=(1, 2))
