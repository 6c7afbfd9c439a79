"""Trains a NeRFactor straight to Ŝ, from the same walks and by the same objective as the neural BSSRDF.

It is the best that its class can do: no picture stands between the BRDF and Ŝ. `nerfactor_pictures.py` trains from
pictures, as published.
"""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.baselines.nerfactor import NeRFactor
from prt_bake.baselines.nerfactor_settings import NeRFactorSettings
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.network.bssrdf import save_model
from prt_bake.network.model import TrainableModel
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.fit import metadata_of
from prt_bake.trainer.learning.learner import Learner, LearningSettings
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.rows import StreamSettings
from prt_bake.trainer.train import train_model
from prt_bake.trainer.training_data import TrainingData
from prt_bake.trainer.validation import VALIDATION_SEED

LEARNING = LearningSettings(muon=False, decay=0.0, bfloat16=False)
"""Adam alone, as published."""
_DIRECTIONS = 1024
"""Of light, many: a lobe of the least roughness has a width of one degree."""


def train_nerfactor(
    scene: Scene,
    *,
    settings: NeRFactorSettings | None = None,
    seed: int = 0,
    device: str = "cpu",
    output: str | Path | None = None,
    learning: LearningSettings | None = None,
    stream: StreamSettings | None = None,
    **run: Any,
) -> NeRFactor:
    """Train a NeRFactor of a scene from walks.

    Args:
        scene: the scene to path trace.
        settings: the model; by default the published size with `seed`, and any positive albedo.
        device: "cpu" or "auto".
        seed, output, learning, stream, run: as for `prt_bake.trainer.train.train`.

    Raises QueryError for another device, and what `prt.train` raises.

    >>> import prt_bake as prt
    >>> from prt_bake.baselines.nerfactor_training import train_nerfactor
    >>> model = train_nerfactor(prt.load_scene("spot.toml"), steps=2)
    >>> model.settings.width
    128
    """
    refuse_other_device(device)
    chosen = settings or NeRFactorSettings(bounded=False, seed=seed)
    model = train_model(
        scene,
        lambda data, _device: NeRFactorFit(data, chosen),
        seed=seed,
        device="cpu",
        output=output,
        learning=learning or LEARNING,
        stream=stream,
        **run,
    )
    assert isinstance(model, NeRFactor)
    model.metadata["training"]["lobe_share"] = lobe_share(model, scene)
    if output is not None:
        save_model(model, output)
    return model


def lobe_share(model: NeRFactor, scene: Scene, queries: int = 256) -> float:
    """The share of the glossy lobe in the model's Ŝ, integrated over the light, at held-out queries.

    Light reflected at the surface is not in Ŝ. The lobe explains scattered light where it helps to.
    """
    held_out = QuerySource(prepare(scene), 1, VALIDATION_SEED).draw(0, queries)
    diffuse = deepcopy(model)
    diffuse.settings = replace(model.settings, reflectance=0.0)
    total, rest = (
        float(each.evaluate(fibonacci(_DIRECTIONS), held_out.positions, held_out.outgoing).sum(dtype=np.float64))
        for each in (model, diffuse)
    )
    return 1.0 - rest / total if total > 0.0 else 0.0


def refuse_other_device(device: str) -> None:
    """Raise QueryError for a device that a NeRFactor does not learn on."""
    if device not in ("cpu", "auto"):
        raise QueryError(f"NeRFactor: learns on the processor only; expected device 'cpu', found {device!r}")


class NeRFactorFit:
    """Fits a NeRFactor (`prt_bake.trainer.fit.Fit`)."""

    def __init__(self, data: TrainingData, settings: NeRFactorSettings) -> None:
        """Fit the BRDF of the scene's object."""
        self._scene, self._settings = data.scene, settings
        self.resume_settings: dict[str, Any] = {
            f"nerfactor {name}": value for name, value in settings.as_json().items()
        }

    def model(self, output_scale: float) -> NeRFactor:
        """The model before its first step."""
        return NeRFactor(self._settings, self._scene.mesh, output_scale, metadata_of(self._scene))

    def learner(self, model: TrainableModel, learning: LearningSettings) -> Learner:
        """Adam on both MLPs."""
        return NeRFactorLearner(model, learning)


class NeRFactorLearner(Learner):
    """A learner whose optimiser is Adam alone."""

    def _optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.network.parameters(), lr=self.settings.rate, betas=(0.9, 0.99))]
