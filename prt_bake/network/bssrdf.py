"""The neural BSSRDF: a small network fitted to the transport function Ŝ(ωi; x, ωo) [1/sr] of one object.

The inputs are u = (ωi, x, ωo), in this order. Positions become (x − box_min) / box_side in float64 before they are
rounded to float32. Fourier features [cos 2πGu, sin 2πGu] go through hidden layers with concatenated skips and a linear
layer to RGB, times `output_scale`.

With `light_layers` the first layers (the trunk) see only u = (x, ωo) and run once per view. Features of ωi and powers
of ωi·ωo are appended to the inputs of the last layers. The optional features of the settings are described in
`features` (`view_features`, `shape`, `feature_grid`, `light_ray`) and in `lobes`. Bakes to degree 2 use `low_bands`.
"""

import json
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from formats.errors import ModelError, refuse_path
from formats.json_report import as_line
from formats.json_values import (
    ERROR_INTERVAL,
    ERROR_OR_UNKNOWN,
    REFRACTIVE_INDEX,
    ROUGHNESS,
    TABLE,
    TEXT,
    Check,
    one_of,
    value_faults,
)
from formats.mesh import Mesh
from prt_bake.network.checkpoint import check_tensors, read_checkpoint, write_checkpoint
from prt_bake.network.core import NetworkCore
from prt_bake.network.features.interior import Interior
from prt_bake.network.inference.fused import FusedNetwork
from prt_bake.network.inference.prepared import prepared_for
from prt_bake.network.lobes import LOBE_PARAMETERS
from prt_bake.network.low_bands import correction_inputs, low_shapes
from prt_bake.network.model import NEURAL_BSSRDF, Model, model_of_kind
from prt_bake.network.settings import LEAST_LAYERS, PRESETS, NetworkSettings

__all__ = ["PRESETS", "NetworkSettings", "NeuralBSSRDF", "load_model", "save_model"]

FORMAT = "prtbake model"
FORMAT_VERSION = 1
INTERIOR, INNER, MATERIAL = "interior", "inner", "material"
"""Names of the checkpoint's tensors that hold the interior's grids, the meshes inside, and the material."""
_METADATA: Mapping[str, Check] = {
    "up": one_of("y", "z"),
    "unit": TEXT,
    "eta": REFRACTIVE_INDEX,
    "roughness": ROUGHNESS,
    "normals": one_of("face", "vertex"),
    "training": TABLE,
}
"""Entries of the metadata that bakes and pictures read; others are only handed on."""
_ERRORS: Mapping[str, Check] = {"coefficients": ERROR_OR_UNKNOWN, "coefficients_interval": ERROR_INTERVAL}
_MAX_FLOAT16 = float(torch.finfo(torch.float16).max)


class NeuralBSSRDF(NetworkCore):
    """Ŝ as a network: a transport for `prt.bake`, and the module that the trainer fits.

    >>> import prt_bake as prt
    >>> network = prt.NeuralBSSRDF(box_min=(-1.0, -1.0, -1.0), box_side=2.0)
    >>> network.evaluate([[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0]], [[0.6, 0.0, 0.8]]).shape  # ωi, x, ωo
    (1, 1, 3)
    """

    def extra_repr(self) -> str:
        """The first lines of `repr`: what the network was trained on, and how exact it is."""
        weights = sum(weight.numel() for weight in self.parameters())
        error = self.metadata.get("training", {}).get("relative_rmse", {}).get("coefficients")
        accuracy = f"error of coefficients {error:.2%}" if isinstance(error, float) else "error unknown"
        return f"scene: {self.metadata.get('scene', 'unknown')}, {weights:,} weights, {accuracy}"

    def prepared(self, precision: str = "float32", device: str = "cpu") -> FusedNetwork:
        """A frozen copy with a fused `evaluate_block`; its matrix products run in "float32" or "bfloat16"."""
        return prepared_for(self, precision, device)

    def evaluate_block(
        self, incident: ArrayLike, rotation: ArrayLike, positions: ArrayLike, outgoing: ArrayLike
    ) -> NDArray[np.float32]:
        """Ŝ [N,B,D,3]: bin (n, b) is lit from incident[rotation[n, b]]; see `FusedNetwork.evaluate_block`.

        Each call prepares the network; for many blocks, call `prepared` once and evaluate what it returns.
        """
        fused = self.prepared(device=self.frequencies.device.type)
        return fused.evaluate_block(incident, rotation, positions, outgoing)

    def rounded(self) -> Self:
        """A copy whose weights are float16 numbers: half the size on disk; outputs of trained networks change by 3e-4.

        Weights beyond the range of float16 keep their value.
        """
        copied = deepcopy(self)
        with torch.no_grad():
            for weight in copied.parameters():
                weight.copy_(torch.where(weight.abs() <= _MAX_FLOAT16, weight.half().float(), weight))
        return copied

    def file_content(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """The description and the tensors of the model's file."""
        head = {
            "settings": self.settings.as_json(),
            "box_min": self.box_min.tolist(),
            "box_side": self.box_side,
            "output_scale": self.output_scale,
            "metadata": self.metadata,
        }
        tensors = {name: tensor.detach().float().cpu().contiguous() for name, tensor in self.state_dict().items()}
        if self.view is not None:
            interior = self.view.interior
            head["interior"] = interior.as_json()
            tensors[INTERIOR] = interior.packed()
            if interior.inner:
                tensors[INNER] = interior.packed_inner()
            if interior.material is not None:
                tensors[MATERIAL] = interior.material.packed()
        return head, tensors


def save_model(network: Model, path: str | Path) -> None:
    """Writes a model as `.pt` or `.safetensors`: tensors, and everything else as JSON.

    A tensor is stored in float16 if that is exact (see `rounded`), else in float32. Rounded networks of the presets
    take 372 KiB ("paper") and at most 1,416 KiB ("measured"). Raises ModelError on another suffix or on weights that
    are not finite, StorageError if the file cannot be written. An older file stays as it was on failure.

    >>> import tempfile
    >>> import prt_bake as prt
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     prt.save_model(prt.NeuralBSSRDF(output_scale=0.5), f"{folder}/model.pt")
    ...     prt.load_model(f"{folder}/model.pt").output_scale
    0.5
    """
    refuse_path("network", network, "prt.load_model")
    head, tensors = network.file_content()
    floats = {name: tensor for name, tensor in tensors.items() if tensor.is_floating_point()}
    check_tensors(floats, _shapes(floats), path)
    small = {name: _smallest(tensor) for name, tensor in floats.items()}
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, **head}
    write_checkpoint(path, as_line(head), {**tensors, **small})


def _smallest(tensor: Tensor) -> Tensor:
    half = tensor.half()
    return half if bool((half.float() == tensor).all()) else tensor


def load_model(path: str | Path, device: str = "cpu", *, mesh: Mesh | None = None) -> Model:
    """The model that `save_model` wrote, ready to evaluate on `device`: a neural BSSRDF or a baseline.

    Args:
        path: the file, `.pt` or `.safetensors`.
        device: "cpu" or "cuda".
        mesh: the object's mesh, from which the network takes its normals (`NeuralBSSRDF.on`). Bakes, renders and
            reports give it theirs; whoever evaluates the network alone gives it here, or the first evaluation warns.

    The file cannot run code: only plain tensors and JSON are accepted. Raises ModelError naming the file and the tensor
    or key at fault, QueryError if most vertices of the mesh are off the surface that the network was trained on.

    >>> import prt_bake as prt
    >>> mesh = prt.read_mesh(prt.example("spot.obj"))
    >>> network = prt.load_model(prt.example("spot.pt"), mesh=mesh)
    >>> network.settings.layers, network.settings.width
    (5, 128)
    >>> network.evaluate([[0.0, 1.0, 0.0]], mesh.positions[:2], mesh.normals[:2]).shape  # ωi, x, ωo
    (2, 1, 3)
    """
    refuse_path("mesh", mesh, "prt.read_mesh")
    text, tensors = read_checkpoint(path)
    try:
        head = json.loads(text)
        if head["format"] != FORMAT or head["format_version"] != FORMAT_VERSION:
            raise ModelError(
                f"{path}: expected {FORMAT!r} version {FORMAT_VERSION}, "
                f"found {head['format']!r} version {head['format_version']!r}; give a network of this version, "
                "or train one"
            )
        _check_metadata(head["metadata"])
        kind = head.get("kind", NEURAL_BSSRDF)
        model = _network(head, tensors, path) if kind == NEURAL_BSSRDF else model_of_kind(kind, head, tensors)
    except ModelError as fault:
        raise fault if str(path) in str(fault) else ModelError(f"{path}: {fault}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as fault:
        raise ModelError(
            f"{path}: the model's description is not readable ({fault!r}); train the model again"
        ) from None
    model = model.to(device).eval()
    if mesh is None:
        return model
    model.refuse_foreign(mesh)
    return model.on(mesh)


def _network(head: dict[str, Any], tensors: dict[str, Tensor], path: str | Path) -> NeuralBSSRDF:
    """The neural BSSRDF of a file's content."""
    packed, inner, material = (tensors.pop(name, None) for name in (INTERIOR, INNER, MATERIAL))
    settings = NetworkSettings.from_json(head["settings"])
    _check_size(settings, sum(tensor.numel() for tensor in tensors.values()))
    network = NeuralBSSRDF(
        settings,
        head["box_min"],
        head["box_side"],
        head["output_scale"],
        head["metadata"],
        None if packed is None else Interior.unpacked(head["interior"], packed, inner, material),
    )
    try:
        check_tensors(tensors, _shapes(network.state_dict()), path)
    except ModelError as fault:
        raise ModelError(f"{fault}; copy the file again, or train the model again") from None
    network.load_state_dict(tensors)
    return network


def _check_metadata(metadata: dict[str, Any]) -> None:
    """Raise ModelError naming a value of the metadata that bakes and pictures cannot use."""
    for fault in value_faults(metadata, _METADATA, "metadata."):
        raise ModelError(f"{fault}; copy the file again, or train the model again")
    training = metadata.get("training", {})
    for fault in value_faults(training, {"relative_rmse": TABLE}, "metadata.training."):
        raise ModelError(f"{fault}; copy the file again, or train the model again")
    for fault in value_faults(training.get("relative_rmse", {}), _ERRORS, "metadata.training.relative_rmse."):
        raise ModelError(f"{fault}; copy the file again, or train the model again")


def _check_size(settings: NetworkSettings, stored: int) -> None:
    """Refuse settings of a larger network than the `stored` numbers, before any memory is reserved for it."""
    if settings.layers + settings.low_layers <= stored:
        lobes = LOBE_PARAMETERS * settings.lobes * settings.width
        low = low_shapes(settings.view_inputs, settings.low_width, settings.low_layers)
        correction = low_shapes(correction_inputs(settings), settings.correction_width, LEAST_LAYERS)
        shapes = (*settings.layer_shapes, *low, *correction)
        if lobes + sum(outputs * inputs for outputs, inputs in shapes) <= stored:
            return
    raise ModelError(f"its settings describe a larger network than its {stored} numbers; copy the file again")


def _shapes(tensors: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}
