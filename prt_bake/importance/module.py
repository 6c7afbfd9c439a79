"""The importance module: from (x, ωo) to the lobe that directions of incidence are drawn from.

Fourier features of its own → 512, 128, 32 ReLU → for each lobe the logarithm of σ, and where the settings say so a
tilt of its axis away from the normal and a weight. It belongs to one model file: it lies beside NAME.pt as
NAME.importance.pt and holds that file's hash.
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.atomic import existing, sha256
from formats.errors import ModelError
from prt_bake.importance.settings import IMPORTANCE_PRESETS, ImportanceSettings
from prt_bake.mathematics.lobe import Lobe
from prt_bake.network.checkpoint import read_checkpoint, refuse_unsound, write_checkpoint

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
"""Radians: narrower lobes than the bins of the fit (32×64 over the sphere) would be noise; wider ones are uniform."""
FIRST_SIGMA = 0.85
ROWS_AT_ONCE = 16384


class ImportanceModule(nn.Module):
    """σ, and the lobe it stands for, of every query on one object."""

    frequencies: Tensor
    box_min: Tensor

    def __init__(
        self,
        settings: ImportanceSettings | None = None,
        box_min: ArrayLike = (0.0, 0.0, 0.0),
        box_side: float = 1.0,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """A fresh module that gives every query the same lobe about its normal, σ = 0.85.

        box_min [3] and box_side (longest side) are the object's bounding box in scene units; metadata is plain JSON and
        travels with the file. Raises ModelError if the box is not finite.
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
        """Makes σ the same for every query of a module that has learnt nothing yet (of several lobes, their middle)."""
        low, high = np.log(SIGMA_RANGE)
        part = np.clip((np.log(sigma) - low) / (high - low), 0.01, 0.99)
        lobes = self.settings.lobes
        with torch.no_grad():
            self.output.bias[:lobes] = float(np.log(part / (1.0 - part)))
            if lobes > 1:
                # Equal lobes would get equal gradients for ever.
                self.output.bias[:lobes] += torch.linspace(-1.0, 1.0, lobes, device=self.output.bias.device)

    def round_as_stored(self) -> None:
        """Rounds the weights to what a file holds, so that a module is the same before it is written and after."""
        with torch.no_grad():
            for weights in self.parameters():
                weights.copy_(_as_stored(weights))

    def _initialise(self, generator: torch.Generator) -> None:
        with torch.no_grad():
            for layer in self.hidden:
                assert isinstance(layer, nn.Linear)
                layer.weight.normal_(0.0, (2.0 / layer.in_features) ** 0.5, generator=generator)
                layer.bias.zero_()
            self.output.weight.zero_()
            self.output.bias.zero_()
            if self.settings.lobes > 1:
                others = self.output.bias[self.settings.lobes :]
                others += 0.1 * torch.randn(len(others), generator=generator)
        self.start_at(FIRST_SIGMA)

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
        """What N queries draw directions of incidence from; normals [N,3] are unit normals of the faces they lie on."""
        sigma, tilts, weights = self._evaluate(positions, outgoing)
        axes = np.asarray(normals, dtype=np.float64)[:, None, :] + tilts
        length = np.linalg.norm(axes, axis=2, keepdims=True)
        upright = np.broadcast_to(np.asarray(normals, dtype=np.float64)[:, None, :], axes.shape)
        axes = np.where(length > 1e-6, axes / np.maximum(length, 1e-6), upright)
        weights /= weights.sum(axis=1, keepdims=True)
        return Lobe(axes, sigma, weights, self.settings.shape, self.settings.uniform_share)

    def _evaluate(self, positions: ArrayLike, outgoing: ArrayLike) -> tuple[NDArray[np.float64], ...]:
        # Copies: the arrays may be read-only, of which torch tensors know nothing.
        x, eye = (torch.from_numpy(np.array(rows, dtype=np.float64)) for rows in (positions, outgoing))
        at = self.frequencies.device
        parts: list[tuple[Tensor, ...]] = []
        with torch.inference_mode():
            for first in range(0, max(1, len(x)), ROWS_AT_ONCE):
                rows = slice(first, first + ROWS_AT_ONCE)
                parts.append(self(x[rows].to(at), eye[rows].to(at)))
        return tuple(torch.cat(part).double().cpu().numpy() for part in zip(*parts, strict=True))

    def _features(self, positions: Tensor, outgoing: Tensor) -> Tensor:
        """[cos 2πGu, sin 2πGu] in float32; the mean's share of the phase is reduced to a cycle in float64."""
        x, d = (positions.double() - self.box_min) / self.box_side, outgoing.double()
        if self.settings.directions == "spherical":
            theta = torch.atan2(torch.linalg.vector_norm(d[:, :2], dim=1), d[:, 2])
            phi = torch.atan2(d[:, 1], d[:, 0]) % (2.0 * torch.pi)
            d = torch.stack((theta / torch.pi, phi / (2.0 * torch.pi)), dim=1)
        u = torch.cat((x, d), dim=1)
        mean = self.settings.feature_mean
        common = (u.sum(dim=1, keepdim=True) * mean) % 1.0
        deviation = (self.frequencies.double() - mean).float()
        phase = (2.0 * torch.pi) * (common.float() + u.float() @ deviation.T)
        return torch.cat((phase.cos(), phase.sin()), dim=1)


def _as_stored(weights: Tensor) -> Tensor:
    """Half the bytes: draw and density see the same rounded lobe, so nothing gets biased."""
    return weights.half().float()


def importance_path(model_path: str | Path) -> Path:
    """Where the importance module of a model lies: NAME.importance.pt beside NAME.pt (.safetensors alike)."""
    path = Path(model_path)
    return path.with_name(f"{path.stem}.importance{path.suffix}")


def save_importance(module: ImportanceModule, model_path: str | Path) -> None:
    """Writes the module beside its model, weights in float16, with the hash of the model's file as it is now.

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
    refuse_unsound(tensors, module.settings.tensor_shapes(), path)
    write_checkpoint(path, json.dumps(head), tensors)


def load_importance(model_path: str | Path, device: str = "cpu") -> ImportanceModule:
    """The importance module of a model, found by the model's name and held against its hash.

    Raises ModelError if there is none, if it belongs to another model or is damaged, with what to do about it;
    StorageError if the model is missing.
    """
    path, model = importance_path(model_path), existing(model_path)
    remedy = f"make it anew: prtbake importance {model_path} MESH"
    if not path.is_file():
        raise ModelError(f"{path}: there is no importance module beside {model.name}; make one: {remedy[14:]}")
    try:
        module, owner = read_importance(path)
    except ModelError as fault:
        raise ModelError(f"{fault}; {remedy}") from None
    found = sha256(model)
    if owner != found:
        raise ModelError(
            f"{path}: belongs to another model (SHA-256 {owner[:12]}…) than {model.name} ({found[:12]}…); {remedy}"
        )
    return module.to(device).eval()


def read_importance(path: str | Path) -> tuple[ImportanceModule, str]:
    """The module that a file holds, and the SHA-256 of the model that it belongs to.

    Nothing in the file is run. Raises ModelError naming the file and the tensor or key at fault.
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
        # Before anything of the size that the settings name is allocated.
        refuse_unsound(tensors, settings.tensor_shapes(), path)
        module = ImportanceModule(settings, head["box_min"], head["box_side"], metadata)
    except ModelError as fault:
        raise fault if str(path) in str(fault) else ModelError(f"{path}: {fault}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise ModelError(f"{path}: the module's description is not readable ({fault!r})") from None
    module.load_state_dict(tensors)
    return module.eval(), owner
