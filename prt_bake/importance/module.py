"""The importance module: from (x, ωo) to the lobe from which incident directions are drawn.

Separate Fourier features → 512, 128, 32 ReLU → for each lobe the logarithm of σ and, depending on the settings, a tilt
of its axis away from the normal and a weight. A module belongs to one model file: it is stored beside NAME.pt as
NAME.importance.pt, with the hash of that file.
"""

import json
import shlex
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.atomic import existing, sha256
from formats.errors import ModelError
from formats.json_report import as_line
from prt_bake.importance.settings import IMPORTANCE_PRESETS, ImportanceSettings
from prt_bake.mathematics.lobe import Lobe
from prt_bake.network.checkpoint import check_tensors, read_checkpoint, write_checkpoint
from prt_bake.network.features.fourier import encode_directions, fourier_features
from prt_bake.network.file_names import importance_path
from prt_bake.network.initial_weights import initialise

__all__ = [
    "IMPORTANCE_PRESETS",
    "ImportanceModule",
    "ImportanceSettings",
    "importance_path",
    "load_importance",
    "read_importance",
    "save_importance",
]

FORMAT = "prtbake importance"
FORMAT_VERSION = 1
SIGMA_RANGE = (0.05, 2.0 * np.pi)
"""Radians: lobes narrower than the bins of the fit (32×64 over the sphere) would fit noise; wider ones are uniform."""
INITIAL_SIGMA = 0.85
ROWS_PER_BATCH = 16384


class ImportanceModule(nn.Module):
    """Predicts σ, and the lobe of incident directions, for queries on one object."""

    frequencies: Tensor
    box_min: Tensor

    def __init__(
        self,
        settings: ImportanceSettings | None = None,
        box_min: ArrayLike = (0.0, 0.0, 0.0),
        box_side: float = 1.0,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """A new module that predicts the same lobe about the normal for every query, σ = 0.85.

        box_min [3] and box_side (longest side) are the object's bounding box in scene units. metadata is plain JSON and
        is stored in the file. Raises ModelError if the box is not finite.
        """
        super().__init__()
        self.settings = settings or ImportanceSettings()
        self.box_side = float(box_side)
        self.metadata: dict[str, Any] = dict(metadata or {})
        corner = torch.as_tensor(np.asarray(box_min, dtype=np.float64))
        if corner.shape != (3,) or not bool(corner.isfinite().all()) or not 0.0 < self.box_side < np.inf:
            raise ModelError(
                f"importance module: box_min must be three finite numbers and box_side finite and positive; "
                f"found {corner.tolist()}, {self.box_side}"
            )
        generator = torch.Generator().manual_seed(self.settings.seed)
        deviation = torch.randn(self.settings.features, self.settings.inputs, generator=generator)
        deviation[:, :3] *= self.settings.position_spread
        deviation[:, 3:] *= self.settings.feature_spread
        self.register_buffer("frequencies", _as_stored(self.settings.feature_mean + deviation))
        self.register_buffer("box_min", corner, persistent=False)
        sizes = (2 * self.settings.features, *self.settings.widths)
        self.hidden = nn.ModuleList(nn.Linear(n, m) for n, m in pairwise(sizes))
        self.output = nn.Linear(sizes[-1], self.settings.outputs)
        self._initialise(generator)

    def start_at(self, sigma: float) -> None:
        """Sets the initial σ of all queries before training; with several lobes, the σ of the middle one."""
        low, high = np.log(SIGMA_RANGE)
        part = np.clip((np.log(sigma) - low) / (high - low), 0.01, 0.99)
        lobes = self.settings.lobes
        with torch.no_grad():
            self.output.bias[:lobes] = float(np.log(part / (1.0 - part)))
            if lobes > 1:
                # Equal lobes would always get equal gradients.
                self.output.bias[:lobes] += torch.linspace(-1.0, 1.0, lobes, device=self.output.bias.device)

    def round_as_stored(self) -> None:
        """Rounds the weights to those that a file stores, so that writing does not change the module."""
        with torch.no_grad():
            for weights in self.parameters():
                weights.copy_(_as_stored(weights))

    def _initialise(self, generator: torch.Generator) -> None:
        for layer in self.hidden:
            initialise(layer, 2.0, generator)
        with torch.no_grad():
            self.output.weight.zero_()
            self.output.bias.zero_()
            if self.settings.lobes > 1:
                others = self.output.bias[self.settings.lobes :]
                others += 0.1 * torch.randn(len(others), generator=generator)
        self.start_at(INITIAL_SIGMA)

    def forward(self, positions: Tensor, outgoing: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """σ [N,L] in radians, tilts [N,L,3] (added to the unit normal) and weights [N,L]; differentiable."""
        h = self._features(positions, outgoing)
        for layer in self.hidden:
            h = torch.relu(layer(h))
        h, lobes = self.output(h), self.settings.lobes
        low, high = np.log(SIGMA_RANGE)
        sigma = torch.exp(low + (high - low) * torch.sigmoid(h[:, :lobes]))
        tilts = h.new_zeros((len(h), lobes, 3))
        if self.settings.tilted:
            tilts = h[:, lobes : 4 * lobes].reshape(-1, lobes, 3)
        weights = torch.softmax(h[:, -lobes:], dim=1) if lobes > 1 else torch.ones_like(sigma)
        return sigma, tilts, weights

    def sigma(self, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float64]:
        """σ in radians of queries positions [N,3], outgoing [N,3] in object space: [N], or [N,L] with L > 1 lobes."""
        sigma, _tilts, _weights = self._evaluate(positions, outgoing)
        return sigma[:, 0] if self.settings.lobes == 1 else sigma

    def lobe(self, positions: ArrayLike, outgoing: ArrayLike, normals: ArrayLike) -> Lobe:
        """The lobes from which N queries draw incident directions; normals [N,3] are unit normals of their faces."""
        sigma, tilts, weights = self._evaluate(positions, outgoing)
        axes = np.asarray(normals, dtype=np.float64)[:, None, :] + tilts
        length = np.linalg.norm(axes, axis=2, keepdims=True)
        upright = np.broadcast_to(np.asarray(normals, dtype=np.float64)[:, None, :], axes.shape)
        axes = np.where(length > 1e-6, axes / np.maximum(length, 1e-6), upright)
        weights /= weights.sum(axis=1, keepdims=True)
        return Lobe(axes, sigma, weights, self.settings.shape, self.settings.uniform_share)

    def _evaluate(self, positions: ArrayLike, outgoing: ArrayLike) -> tuple[NDArray[np.float64], ...]:
        # Copies: torch does not support read-only arrays.
        x, eye = (torch.from_numpy(np.array(rows, dtype=np.float64)) for rows in (positions, outgoing))
        at = self.frequencies.device
        parts: list[tuple[Tensor, ...]] = []
        with torch.inference_mode():
            for first in range(0, max(1, len(x)), ROWS_PER_BATCH):
                rows = slice(first, first + ROWS_PER_BATCH)
                parts.append(self(x[rows].to(at), eye[rows].to(at)))
        return tuple(torch.cat(part).double().cpu().numpy() for part in zip(*parts, strict=True))

    def _features(self, positions: Tensor, outgoing: Tensor) -> Tensor:
        relative = (positions.double() - self.box_min) / self.box_side
        u = torch.cat((relative, encode_directions(outgoing, self.settings.directions)), dim=1)
        return fourier_features(u, self.frequencies, self.settings.feature_mean)


def _as_stored(weights: Tensor) -> Tensor:
    """Float16 halves the file. Sampling and density use the same rounded lobe, so the estimate stays unbiased."""
    return weights.half().float()


def save_importance(module: ImportanceModule, model_path: str | Path) -> None:
    """Writes the module beside its model, weights in float16, with the current hash of the model's file.

    Raises StorageError if there is no model or the file cannot be written, ModelError on weights that are not finite.
    """
    path = importance_path(model_path)
    head = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "model_sha256": sha256(existing(model_path)),
        "settings": module.settings.as_json(),
        "box_min": module.box_min.tolist(),
        "box_side": module.box_side,
        "metadata": module.metadata,
    }
    tensors = {name: tensor.detach().half().cpu().contiguous() for name, tensor in module.state_dict().items()}
    check_tensors(tensors, module.settings.tensor_shapes(), path)
    write_checkpoint(path, as_line(head), tensors)


def load_importance(model_path: str | Path, device: str = "cpu") -> ImportanceModule:
    """The importance module of a model, found by the model's name and checked against its hash.

    Raises ModelError, with the command that helps, if there is none, if it belongs to another model or is damaged;
    StorageError if the model is missing.
    """
    path, model = importance_path(model_path), existing(model_path)
    command = f"prtbake importance {shlex.quote(str(model_path))} MESH"
    remedy = f"fit it again: {command}"
    if not path.is_file():
        raise ModelError(f"{path}: there is no importance module beside {model.name}; fit one: {command}")
    try:
        module, owner = read_importance(path)
    except ModelError as fault:
        raise ModelError(f"{fault}; {remedy}") from None
    found = sha256(model)
    if owner != found:
        raise ModelError(
            f"{path}: belongs to another model (SHA-256 {owner[:12]}…), not to {model.name} ({found[:12]}…); {remedy}"
        )
    return module.to(device).eval()


def read_importance(path: str | Path) -> tuple[ImportanceModule, str]:
    """The module in a file, and the SHA-256 of the model to which it belongs.

    The file cannot run code. Raises ModelError naming the file and the tensor or key at fault.
    """
    text, tensors = read_checkpoint(path)
    try:
        head = json.loads(text)
        if head["format"] != FORMAT or head["format_version"] != FORMAT_VERSION:
            raise ModelError(
                f"{path}: expected {FORMAT!r} version {FORMAT_VERSION}, "
                f"found {head['format']!r} version {head['format_version']!r}"
            )
        owner, metadata = str(head["model_sha256"]), dict(head["metadata"])
        settings = ImportanceSettings.from_json(head["settings"])
        # Checked before tensors of the sizes in the settings are allocated.
        check_tensors(tensors, settings.tensor_shapes(), path)
        module = ImportanceModule(settings, head["box_min"], head["box_side"], metadata)
    except ModelError as fault:
        raise fault if str(path) in str(fault) else ModelError(f"{path}: {fault}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise ModelError(f"{path}: the module's description is not readable ({fault!r})") from None
    module.load_state_dict(tensors)
    return module.eval(), owner
