"""What a training fits: the neural BSSRDF, or another model that brings its own learner."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF
from prt_bake.network.inference.pairs import content_hash
from prt_bake.network.low_bands import LowBands
from prt_bake.network.model import TrainableModel
from prt_bake.network.starting_weights import earlier_low_bands, refuse_other_layers, start_from
from prt_bake.tracer.prepared import interface_kind, is_unrefracted
from prt_bake.tracer.surface.interface import ROUGH
from prt_bake.trainer.interior import interior_of, is_clear, with_fitting_grid
from prt_bake.trainer.learning.learner import Learner, LearningSettings
from prt_bake.trainer.learning.low_bands import OnlyLowBands
from prt_bake.trainer.training_data import TrainingData, box_of


class Fit(Protocol):
    """Makes the model of a run, and what learns its weights."""

    resume_settings: dict[str, Any]
    """Settings of the model that a resumed run must share with the run that it continues."""

    def model(self, output_scale: float) -> TrainableModel:
        """The model before its first step, bound to the scene's mesh."""

    def learner(self, model: TrainableModel, learning: LearningSettings) -> Learner:
        """What learns the model's weights."""


class NetworkFit:
    """Fits a neural BSSRDF."""

    def __init__(
        self,
        data: TrainingData,
        settings: NetworkSettings,
        device: str,
        start: NeuralBSSRDF | None = None,
        only_low_bands: bool = False,
    ) -> None:
        """Measure the interior of the scene's object. Inputs that are useless for the scene are left out.

        start: has the weights to begin with, and to keep in all layers but the low bands if `only_low_bands` is set.
        """
        self._start, self._only_low_bands = start, only_low_bands
        self._scene, self._box, self._device, self._on_gpu = data.scene, data.box, device, data.on_gpu
        settings, self._interior = settings_for(settings, data.scene), None
        if only_low_bands and not settings.low_width:
            raise QueryError(
                f"{data.scene.path}: its networks have no low bands, since its boundary does not bend light, or the "
                "settings leave them out; train without only_low_bands"
            )
        if start is not None:
            refuse_other_layers(settings, start.settings)
        if settings.ray_samples:
            interfaces, material = settings.interfaces > 0, settings.material_channels > 0
            self._interior = interior_of(data.scene, data.box, interfaces, material)
            settings = with_fitting_grid(settings, self._interior)
        self._settings = settings
        self.earlier_low: LowBands | None = None
        """The low bands of the network to start from, if those of `model` have the same inputs."""
        self.earlier_correction: LowBands | None = None
        """The correction of the network to start from, if all that it sees stays."""
        self.resume_settings = {
            **{f"network {name}": value for name, value in settings.as_json().items()},
            "interior": "" if self._interior is None else self._interior.content_hash,
            "start": None if start is None else content_hash(start),
            "only low bands": only_low_bands,
        }

    def model(self, output_scale: float) -> NeuralBSSRDF:
        """The network before its first step."""
        box, metadata = self._box, metadata_of(self._scene)
        if self._start is not None:
            metadata["started_from"] = _in_words(self._start)
        network = NeuralBSSRDF(self._settings, box.corner, box.side, output_scale, metadata, self._interior)
        network = network.to(self._device).on(self._scene.mesh)
        if self._start is not None:
            start_from(network, self._start)
            low = earlier_low_bands(network.settings, self._start)
            self.earlier_low = None if low is None else low.to(self._device)
            if self._only_low_bands and self._start.correction is not None and same_inputs(network, self._start):
                self.earlier_correction = deepcopy(self._start.correction).to(self._device)
        return network

    def learner(self, model: TrainableModel, learning: LearningSettings) -> Learner:
        """The learner of the device that path traces."""
        if self._only_low_bands:
            return OnlyLowBands(model, learning)
        if not self._on_gpu:
            return Learner(model, learning)
        from prt_bake.trainer.gpu.learner import GpuLearner

        assert isinstance(model, NeuralBSSRDF)
        return GpuLearner(model, learning)


def same_inputs(network: NeuralBSSRDF, start: NeuralBSSRDF) -> bool:
    """Whether all layers but the low bands and the correction see the same."""
    others = ("low_width", "low_layers", "correction_width", "seed")
    now, before = network.settings.as_json(), start.settings.as_json()
    return all(now[name] == before[name] for name in now if name not in others)


def settings_for(settings: NetworkSettings, scene: Scene) -> NetworkSettings:
    """The settings without inputs that are useless for the scene.

    The normal is useless where the boundary does not bend light. Refracted rays are useless where they hardly ever
    reach the other side. Lobes are useless where hardly any light crosses unscattered, and where a smooth interface
    excludes that light from Ŝ.
    """
    if len(scene.parts) == 1:
        settings = replace(settings, inner_bodies=False)
    if is_unrefracted(scene):
        return replace(settings, tells_normal=False, interfaces=0, lobes=0, low_width=0, low_axes=False)
    if not is_clear(scene, box_of(scene)):
        return replace(settings, interfaces=0, lobes=0)
    return settings if interface_kind(scene) == ROUGH else replace(settings, lobes=0)


def metadata_of(scene: Scene) -> dict[str, Any]:
    """The entries of a model's metadata that its scene gives."""
    return {
        "scene": Path(scene.path).name,
        "scene_hash": scene.content_hash,
        "up": scene.up,
        "unit": scene.unit,
        "eta": float(scene.eta),
        "roughness": float(np.mean(scene.roughness)),
        "normals": scene.normals,
        **_material_of(scene),
    }


def _in_words(network: NeuralBSSRDF) -> str:
    """What a network was trained on, and for how long."""
    scene, training = network.metadata.get("scene", "unknown scene"), network.metadata.get("training", {})
    return f"{scene}, {training.get('steps', 0)} steps"


def _material_of(scene: Scene) -> dict[str, str]:
    """The name and density of the object's material in words; nothing for numbers and grids."""
    table = scene.tables.medium
    if table is None or table.material is None:
        return {}
    density = f", density {table.density:g}" if table.density != 1.0 else ""
    mixed = f", mixed with {table.mix.material or 'numbers'}" if table.mix is not None else ""
    return {"material": table.material + density + mixed}
