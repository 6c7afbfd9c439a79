"""NeRFactor with known geometry: a BRDF that varies over the surface gives Ŝ = V f max(n·ωi, 0) [1/sr].

Zhang, Srinivasan, Deng, Debevec, Freeman and Barron 2021, "NeRFactor: Neural factorization of shape and reflectance
under an unknown illumination", ACM TOG 40(6), in its microfacet variant. MLPs of the position give albedo and
roughness. Visibility V is that of the mesh. Light that enters the object elsewhere, or comes from behind the surface,
is beyond any BRDF: Ŝ is 0 there.
"""

from copy import copy, deepcopy
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.errors import ModelError, QueryError
from formats.mesh import Mesh, as_mesh
from prt_bake.baselines.lit_surface import LitSurface, Points
from prt_bake.baselines.nerfactor_settings import NeRFactorSettings
from prt_bake.network.checkpoint import check_tensors
from prt_bake.network.lobes import Lobes
from prt_bake.network.model import TrainableModel
from prt_bake.network.queries import queries

_ROWS_PER_BATCH = 1 << 16
_MAX_FLOAT16 = float(torch.finfo(torch.float16).max)
_OBJECT = ("positions", "faces", "normals")
"""Tensors of the file that hold the object."""
_ALBEDO_LOW, _ALBEDO_RANGE = 0.03, 0.77
_FIRST_ROUGHNESS = 0.3


class NeRFactorView(NamedTuple):
    """What views [N] need, whatever the weights are: points of the surface, and encoded positions [N,inputs]."""

    points: Points
    encoded: Tensor


class NeRFactor(TrainableModel):
    """Ŝ of a BRDF: a transport for `prt.bake`, and the module that `train_nerfactor` fits."""

    kind = "nerfactor"
    albedo_scale: Tensor
    """Factor [3] of the albedo."""

    def __init__(
        self,
        settings: NeRFactorSettings,
        mesh: Mesh,
        output_scale: float = 1.0,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """A freshly initialised model of the object `mesh`.

        output_scale: unit of `components` [1/sr]; values do not depend on it. metadata: plain JSON, whose "normals"
        says which normals the BRDF has, those of a "face" or those interpolated between a "vertex" and the next.
        """
        super().__init__()
        self.settings: NeRFactorSettings = settings
        self.output_scale, self.metadata = float(output_scale), dict(metadata or {})
        low, high = mesh.bounds
        self.box_side = float((high - low).max())
        self.register_buffer("box_min", torch.from_numpy(low.copy()), persistent=False)
        self.register_buffer("albedo_scale", torch.ones(3))
        kind: Literal["face", "vertex"] = "vertex" if self.metadata.get("normals") == "vertex" else "face"
        self.lit = LitSurface(mesh, kind)
        generator = torch.Generator().manual_seed(settings.seed)
        self.albedo_layers = _layers(settings, 3, generator)
        self.roughness_layers = _layers(settings, 1, generator)
        share = (_FIRST_ROUGHNESS - settings.least_roughness) / (1.0 - settings.least_roughness)
        share = min(max(share, 0.01), 0.99)
        with torch.no_grad():
            _bias(self.roughness_layers[-1]).fill_(float(np.log(share / (1.0 - share))))

    def encode_views(self, positions: Tensor, outgoing: Tensor) -> NeRFactorView:
        """Points and encoded positions of views [N,3]. Raises QueryError for positions off the surface."""
        x, eye = (tensor.detach().double().cpu().numpy() for tensor in (positions, outgoing))
        return NeRFactorView(self.lit.points(x, eye), self.encode_positions(positions))

    def encode_positions(self, positions: Tensor) -> Tensor:
        """Positions [N,3] relative to the box, from −1 to 1, with sines and cosines of all octaves [N,inputs]."""
        return self.encode_relative(2.0 * (positions.double() - self.box_min) / self.box_side - 1.0)

    def encode_relative(self, relative: Tensor) -> Tensor:
        """The encoding [N,inputs] of positions [N,3] in half sides of the box, from −1 to 1."""
        frequencies = 2.0 ** torch.arange(self.settings.octaves, dtype=torch.float64)
        phases = (relative[:, None] * frequencies[:, None]).flatten(1)
        return torch.cat((relative, torch.sin(phases), torch.cos(phases)), dim=1).float()

    def albedo(self, encoded: Tensor) -> Tensor:
        """Albedo [N,3] at encoded positions."""
        raw = _mlp(self.albedo_layers, encoded)
        if self.settings.bounded:
            return self.albedo_scale * (_ALBEDO_LOW + _ALBEDO_RANGE * torch.sigmoid(raw))
        return self.albedo_scale * nn.functional.softplus(raw)

    def roughness_at(self, encoded: Tensor) -> Tensor:
        """Roughness [N,1] at encoded positions; GGX's alpha is its square."""
        least = self.settings.least_roughness
        return least + (1.0 - least) * torch.sigmoid(_mlp(self.roughness_layers, encoded))

    def components(
        self, incident: Tensor, positions: Tensor, outgoing: Tensor, encoding: NeRFactorView | None = None
    ) -> tuple[Tensor, Lobes | None]:
        """Ŝ over the output scale, values [N,D,3] for incident [N,D,3]; there are no lobes to add."""
        view = self.encode_views(positions, outgoing) if encoding is None else encoding
        lambert = self.lit.lambert(view.points, incident.detach().double().cpu().numpy())
        cosines = np.pi * torch.from_numpy(lambert).float()
        values = self.albedo(view.encoded)[:, None] / np.pi * cosines[..., None]
        if self.settings.reflectance > 0.0:
            eye = (torch.from_numpy(view.points.normals).float() * outgoing.float()).sum(dim=1, keepdim=True)
            between = (incident.float() @ outgoing.float()[..., None])[..., 0]
            values = values + self.lobe(view.encoded, cosines, eye, between)[..., None]
        return values / self.output_scale, None

    def lobe(self, encoded: Tensor, cosines: Tensor, eye: Tensor, between: Tensor) -> Tensor:
        """The glossy part of Ŝ [N,D] at encoded positions; other arguments as in `glossy`."""
        return glossy(self.roughness_at(encoded) ** 2, self.settings.reflectance, cosines, eye, between)

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3] in 1/sr, float32: incident [D,3] shared by all queries or [N,D,3], positions [N,3], outgoing [N,3].

        Raises QueryError for other shapes, directions that are not unit vectors and positions off the surface.
        """
        light, x, eye = queries(incident, positions, outgoing, self.box_min.device)
        count, directions = len(x), light.shape[-2]
        light = light.expand(count, directions, 3)
        result = np.empty((count, directions, 3), np.float32)
        at_once = max(1, _ROWS_PER_BATCH // max(1, directions))
        with torch.inference_mode():
            for n in range(0, count, at_once):
                rows = slice(n, n + at_once)
                values, _none = self.components(light[rows], x[rows], eye[rows])
                result[rows] = (self.output_scale * values).numpy()
        return result

    def on(self, mesh: Mesh) -> Self:
        """Itself: the model knows its object's mesh."""
        as_mesh("mesh", mesh)
        return self

    def refuse_foreign(self, mesh: Mesh) -> None:
        """Raise QueryError if a vertex of the mesh is off the surface of the model's object."""
        off = self.lit.off_surface(mesh).tolist()
        if off:
            raise QueryError(
                f"mesh: expected the surface of the model's object, found {len(off)} of {len(mesh.positions)} vertices "
                f"off it, first number {off[0]}; bake the mesh of the model's own scene, or train a model on this mesh"
            )

    def rounded(self) -> Self:
        """A copy whose weights are float16 numbers."""
        copied = deepcopy(self)
        with torch.no_grad():
            for weight in copied.parameters():
                weight.copy_(torch.where(weight.abs() <= _MAX_FLOAT16, weight.half().float(), weight))
        return copied

    def file_content(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """The description and the tensors of the model's file: weights and the object."""
        head = {
            "kind": self.kind,
            "settings": self.settings.as_json(),
            "output_scale": self.output_scale,
            "metadata": self.metadata,
        }
        mesh = self.lit.mesh
        tensors = {name: tensor.detach().float().cpu().contiguous() for name, tensor in self.state_dict().items()}
        arrays: list[NDArray[Any]] = [mesh.positions, mesh.faces, mesh.normals]
        for name, array in zip(_OBJECT, arrays, strict=True):
            tensors[name] = _stored(array)
        return head, tensors

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """A copy with weights of its own and the same object."""
        copied = copy(self)
        for name in ("_parameters", "_modules", "_buffers"):
            setattr(copied, name, deepcopy(getattr(self, name), memo))
        copied.metadata = deepcopy(self.metadata, memo)
        return copied


def glossy(alpha: Tensor, reflectance: float, cosines: Tensor, eye: Tensor, between: Tensor) -> Tensor:
    """f V max(n·ωi, 0) [N,D] of the lobe alone.

    alpha [N,1]; cosines: V max(n·ωi, 0) [N,D]; eye: n·ωo [N,1]; between: ωi·ωo [N,D]. GGX with separable Smith masking
    (Walter et al. 2007) and Schlick's Fresnel reflectance.
    """
    to_half = (0.5 + 0.5 * between).clamp(min=1e-6).sqrt()  # ωi·h, for |ωi + ωo| = 2 ωi·h
    facing = (0.5 * (cosines + eye) / to_half).clamp(max=1.0)
    distribution = alpha**2 / (np.pi * (1.0 - facing**2 * (1.0 - alpha**2)) ** 2)
    fresnel = reflectance + (1.0 - reflectance) * (1.0 - to_half).clamp(min=0.0) ** 5
    masking = _masking_per_cosine(cosines, alpha) * _masking_per_cosine(eye.clamp(min=0.0), alpha)
    return torch.where(eye > 0.0, 0.25 * fresnel * distribution * masking * cosines, 0.0)


def from_file(head: dict[str, Any], tensors: dict[str, Tensor]) -> NeRFactor:
    """The model of a file's description and tensors; raises ModelError for content that does not fit."""
    settings = NeRFactorSettings.from_json(head["settings"])
    missing = [name for name in _OBJECT if name not in tensors]
    if missing:
        raise ModelError(f"tensor {missing[0]} is missing; copy the file again, or train the model again")
    positions, faces, normals = (tensors.pop(name).double().numpy() for name in _OBJECT)
    _check_size(settings, sum(tensor.numel() for tensor in tensors.values()))
    mesh = Mesh(positions, faces.astype(np.int64), normals)
    model = NeRFactor(settings, mesh, float(head["output_scale"]), head["metadata"])
    check_tensors(tensors, {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}, "the model")
    model.load_state_dict(tensors)
    return model


def _check_size(settings: NeRFactorSettings, stored: int) -> None:
    """Refuse settings of a larger model than the `stored` numbers, before any memory is reserved for it."""
    needed = sum(inputs * width for outputs in (3, 1) for inputs, width in settings.layer_shapes(outputs))
    if needed > stored:
        raise ModelError(f"its settings describe a larger model than its {stored} numbers; copy the file again")


def _stored(array: NDArray[Any]) -> Tensor:
    """Numbers for a file, exact: in float32 if that holds them, else in float64."""
    double = torch.from_numpy(np.array(array, np.float64))
    return double.float() if bool((double.float().double() == double).all()) else double


def _masking_per_cosine(cosine: Tensor, alpha: Tensor) -> Tensor:
    """Smith's G1 over the cosine, which has a limit at grazing."""
    return 2.0 / (cosine + torch.sqrt(cosine**2 + alpha**2 * (1.0 - cosine**2).clamp(min=0.0)).clamp(min=1e-6))


def _layers(settings: NeRFactorSettings, outputs: int, generator: torch.Generator) -> nn.ModuleList:
    layers = nn.ModuleList(nn.Linear(inputs, width) for inputs, width in settings.layer_shapes(outputs))
    for layer in layers:
        assert isinstance(layer, nn.Linear)
        nn.init.xavier_uniform_(layer.weight, generator=generator)
        nn.init.zeros_(layer.bias)
    return layers


def _bias(layer: nn.Module) -> Tensor:
    assert isinstance(layer, nn.Linear)
    return layer.bias


def _mlp(layers: nn.ModuleList, encoded: Tensor) -> Tensor:
    """ReLU layers; the last hidden one sees the encoded position again."""
    *hidden, last, output = layers
    h = encoded
    for layer in hidden:
        h = torch.relu(layer(h))
    result: Tensor = output(torch.relu(last(torch.cat((h, encoded), dim=1))))
    return result
