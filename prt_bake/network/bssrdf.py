"""The neural BSSRDF: a small network fitted to the transport function Ŝ(ωi; x, ωo) [1/sr] of one object.

Input u = (ωi, x, ωo), in this order, each scaled as the settings say; positions become (x − box_min) / box_side in
float64 before they are rounded to float32. Fourier features [cos 2πGu, sin 2πGu] → hidden layers with concatenated
skips → linear layer to RGB, times `output_scale`. Where the settings have ωi enter late, u = (x, ωo), and the features
of ωi, and powers of ωi·ωo, are appended to the inputs of the last hidden layers: what comes before is run once for all
directions. What `ray_samples`, `shape_places`, `grid_places`, `light_places` and `lobes` add is said in the modules
`view_features`, `shape`, `feature_grid`, `light_ray` and `lobes` of `prt_bake.neural`.
"""

import json
from copy import copy, deepcopy
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.errors import ModelError
from formats.mesh import Mesh
from prt_bake.geometry.surface import Surface
from prt_bake.network.checkpoint import read_checkpoint, refuse_unsound, write_checkpoint
from prt_bake.network.features.interior import Interior
from prt_bake.network.features.view_features import ViewEncoding, ViewFeatures
from prt_bake.network.inference.fused import FusedNetwork, prepared_for
from prt_bake.network.inference.late_layers import joined
from prt_bake.network.lobes import LOBE_PARAMETERS, Lobes, evaluate_lobes, decode_lobes
from prt_bake.network.settings import EXIT_INPUTS, PRESETS, NetworkSettings

__all__ = ["PRESETS", "NetworkSettings", "NeuralBSSRDF", "load_model", "save_model"]

FORMAT = "prtbake model"
FORMAT_VERSION = 1
INTERIOR = "interior"
"""The tensor of a checkpoint that holds the interior's grid."""
ROWS_PER_BATCH = 8192
_FIRST_LOBES = 0.02
"""Spread of the weights that lobes begin with: all much alike, but not the same."""
_LARGEST_HALF = float(torch.finfo(torch.float16).max)


class NeuralBSSRDF(nn.Module):
    """Ŝ as a network; a transport for `prt.bake`, a module for the trainer."""

    frequencies: Tensor
    light_frequencies: Tensor
    box_min: Tensor

    def __init__(
        self,
        settings: NetworkSettings | None = None,
        box_min: ArrayLike = (0.0, 0.0, 0.0),
        box_side: float = 1.0,
        output_scale: float = 1.0,
        metadata: dict[str, Any] | None = None,
        interior: Interior | None = None,
    ) -> None:
        """A freshly initialised network.

        box_min [3] and box_side (longest side) are the object's bounding box in scene units; output_scale [1/sr] is
        what the last layer's output is multiplied by; metadata is plain JSON and travels with the checkpoint. Weights
        follow He et al. 2015 and, with G, depend on settings.seed alone. `interior` is for networks that look along the
        ray of view (settings.ray_samples). Raises ModelError if the box is not finite, or an interior is missing.
        """
        super().__init__()
        self.settings = settings or NetworkSettings()
        self.box_side = float(box_side)
        self.output_scale = float(output_scale)
        self.metadata: dict[str, Any] = dict(metadata or {})
        corner = torch.as_tensor(np.asarray(box_min, dtype=np.float64))
        scales = (self.box_side, self.output_scale)
        if (
            corner.shape != (3,)
            or not bool(corner.isfinite().all())
            or not all(np.isfinite(scales))
            or min(scales) <= 0
        ):
            raise ModelError(
                f"network: box_min must be three finite numbers, box_side and output_scale finite and positive; "
                f"found {corner.tolist()}, {self.box_side}, {self.output_scale}"
            )
        generator = torch.Generator().manual_seed(self.settings.seed)
        self._draw_frequencies(generator)
        self.register_buffer("box_min", corner, persistent=False)
        self.hidden = nn.ModuleList(nn.Linear(n, m) for m, n in self.settings.layer_shapes[:-1])
        self.output = nn.Linear(self.settings.width, 3)
        self.lobes = nn.Linear(self.settings.width, LOBE_PARAMETERS * self.settings.lobes) if self.settings.lobes else None
        self._initialise(generator)
        if (interior is None) != (self.settings.ray_samples == 0):
            raise ModelError(
                f"network: an interior belongs to networks with ray_samples, and to them alone; "
                f"found {'none' if interior is None else 'one'} for {self.settings.ray_samples}"
            )
        self.surface: Surface | None = None
        """The object's own mesh, where it is known: see `on`."""
        self.band: int | None = None
        """The degree up to which lobes are told: see `up_to`."""
        self.view = None if interior is None else ViewFeatures(self.settings, self.frequencies, interior)

    def _draw_frequencies(self, generator: torch.Generator) -> None:
        settings = self.settings
        spread = [settings.position_spread] * 3 + [settings.feature_spread] * settings.across
        if not settings.trunk:
            spread = [settings.feature_spread] * settings.across + spread
        deviation = torch.randn(settings.features, len(spread), generator=generator) * torch.tensor(spread)
        self.register_buffer("frequencies", settings.feature_mean + deviation)
        if settings.trunk:
            light = torch.randn(settings.light_features, settings.across, generator=generator)
            self.register_buffer("light_frequencies", settings.light_spread * light)

    def _initialise(self, generator: torch.Generator) -> None:
        for layer in (*self.hidden, self.output):
            assert isinstance(layer, nn.Linear)
            gain = 1.0 if layer is self.output else 2.0
            with torch.no_grad():
                layer.weight.normal_(0.0, (gain / layer.in_features) ** 0.5, generator=generator)
                layer.bias.zero_()
        if self.lobes is not None:
            with torch.no_grad():
                self.lobes.weight.normal_(0.0, _FIRST_LOBES, generator=generator)
                self.lobes.bias.zero_()

    def forward(self, incident: Tensor, positions: Tensor, outgoing: Tensor) -> Tensor:
        """Ŝ [N,3] in 1/sr: unit vectors incident [N,3] and outgoing [N,3], positions [N,3] in object space.

        Differentiable in the weights. Positions may be float64 and are made relative to the box before rounding.
        Runs in the dtype of the weights from the features on (autocast works).
        """
        return self.radiance(incident[:, None], positions, outgoing)[:, 0]

    def radiance(self, incident: Tensor, positions: Tensor, outgoing: Tensor) -> Tensor:
        """Ŝ [N,D,3] in 1/sr, as `forward`, for D directions of incidence a query: incident [N,D,3]."""
        smooth, lobes = self.parts(incident, positions, outgoing)
        answer = smooth if lobes is None else smooth.float() + evaluate_lobes(lobes, incident, self.band)
        return answer * self.output_scale

    def parts(
        self, incident: Tensor, positions: Tensor, outgoing: Tensor, told: ViewEncoding | None = None
    ) -> tuple[Tensor, Lobes | None]:
        """Ŝ over the output scale as what the layers say [N,D,3] and the lobes that are to be added to it.

        `told` is what `told` said of the same views, where that has been asked already.
        """
        lobes = None
        kind = self.output.weight.dtype
        if self.settings.trunk:
            known = self.told(positions, outgoing) if told is None else told
            features = self.view_features(positions, outgoing, known)
            h = features[:, None]
            pairs = self.pair_features(incident, outgoing, None if known is None else known.frame)
            light = torch.cat((self.light_features(incident), pairs), dim=-1).to(kind)
        else:
            wide = incident.shape
            h = self.fourier_features(
                self.inputs(incident, positions[:, None].expand(wide), outgoing[:, None].expand(wide))
            )
        h = h.to(kind)
        activations: list[Tensor] = []
        for number, layer in enumerate(self.hidden, start=1):
            parts = [h, *(activations[source - 1] for source in self.settings.sources(number))]
            if 0 < self.settings.trunk < number:
                parts.append(light)
            h = joined(layer, parts)
            h = torch.relu(h) if self.settings.activation == "relu" else torch.nn.functional.silu(h)
            activations.append(h)
            if self.lobes is not None and number == self.settings.trunk:
                lobes = decode_lobes(self.lobes(h)[:, 0], features[:, -EXIT_INPUTS:])
        return self.output(h), lobes

    def view_features(self, positions: Tensor, outgoing: Tensor, told: ViewEncoding | None = None) -> Tensor:
        """What the first layer of a network that sees ωi late is told of views [N, settings.view_inputs], float32."""
        if self.view is None:
            return self.fourier_features(self.inputs(None, positions, outgoing))
        known = self.told(positions, outgoing) if told is None else told
        assert known is not None
        return self.view.learnt(known)

    def told(self, positions: Tensor, outgoing: Tensor) -> ViewEncoding | None:
        """The part of `view_features` that stays the same while the network learns; None where it is none."""
        if self.view is None:
            return None
        return self.view.told(self._relative(positions), outgoing, self._normals(positions, outgoing))

    def on(self, mesh: Mesh) -> "NeuralBSSRDF":
        """The same network, weights shared, that takes the normals which it is told from its object's mesh.

        Without a mesh it has those of a coarse grid, which round edges off; on it a position on an edge belongs to the
        face that faces ωo most (`prt_bake.geometry.surface`). Networks that are told no normals are given back as they
        are.
        """
        if not self.settings.tells_normal or (self.surface is not None and self.surface.mesh is mesh):
            return self
        bound = copy(self)
        bound.surface = Surface(mesh)
        return bound

    def up_to(self, degree: int) -> "NeuralBSSRDF":
        """The same network, weights shared, with its lobes' bands up to `degree` alone: few directions, which may all
        miss a lobe, then find its coefficients up to that degree exactly. Networks without lobes are given back.
        """
        if self.lobes is None:
            return self
        limited = copy(self)
        limited.band = degree
        return limited

    def rounded(self) -> "NeuralBSSRDF":
        """A copy whose weights float16 holds exactly: half the bytes on disk, answers of trained ones differ by 3e-4.

        Weights beyond what float16 holds stay as they are.
        """
        copied = deepcopy(self)
        with torch.no_grad():
            for weight in copied.parameters():
                weight.copy_(torch.where(weight.abs() <= _LARGEST_HALF, weight.half().float(), weight))
        return copied

    def _normals(self, positions: Tensor, outgoing: Tensor) -> Tensor | None:
        if self.surface is None:
            return None
        kind: Literal["face", "vertex"] = "vertex" if self.metadata.get("normals") == "vertex" else "face"
        x, eye = (tensor.detach().double().cpu().numpy() for tensor in (positions, outgoing))
        return torch.from_numpy(self.surface.normals(x, eye, kind)).to(positions.device)

    def light_features(self, incident: Tensor) -> Tensor:
        """The Fourier features [..., 2·light_features] of directions that enter late, in float32."""
        with torch.autocast(incident.device.type, enabled=False):
            phase = (2.0 * torch.pi) * (self._scale(incident).float() @ self.light_frequencies.T)
            return torch.cat((phase.cos(), phase.sin()), dim=-1)

    def pair_features(self, incident: Tensor, outgoing: Tensor, frame: Tensor | None) -> Tensor:
        """What is told of views and directions together [N,D,settings.pair_inputs] in float32: (ωi·ωo)ⁿ, n from 1, what
        lies on the way to the light, and cosines: incident [N,D,3], outgoing [N,3], `frame` as `ViewEncoding` has it.
        """
        with torch.autocast(incident.device.type, enabled=False):
            cosine = incident.float() @ outgoing.float()[..., None]
            told = [cosine**power for power in range(1, self.settings.angle_powers + 1)]
            if self.view is not None and frame is not None:
                told += self.view.towards(incident.float(), frame)
        return torch.cat((cosine[..., :0], *told), dim=-1)

    def inputs(self, incident: Tensor | None, positions: Tensor, outgoing: Tensor) -> Tensor:
        """The scaled inputs u [N, 7 or 9] in float64: incident direction (unless it enters late), position, outgoing
        direction.
        """
        parts = [] if incident is None else [self._scale(incident)]
        return torch.cat((*parts, self._relative(positions), self._scale(outgoing)), dim=-1)

    def fourier_features(self, u: Tensor) -> Tensor:
        """[cos 2πGu, sin 2πGu] [N, 2·features] in float32, exact to a few 10⁻⁶ whatever the mean of G.

        The mean's share of the phase is the same for all frequencies: it is reduced to a fraction of a cycle in
        float64, so that float32 sees only the deviations from it.
        """
        mean = self.settings.feature_mean
        common = (u.sum(dim=-1, keepdim=True) * mean) % 1.0
        deviation = (self.frequencies.double() - mean).float()
        # Half precision is for weights: phases of several cycles would lose a tenth of a radian to it.
        with torch.autocast(u.device.type, enabled=False):
            phase = (2.0 * torch.pi) * (common.float() + u.float() @ deviation.T)
            return torch.cat((phase.cos(), phase.sin()), dim=-1)

    def _scale(self, directions: Tensor) -> Tensor:
        d = directions.double()
        if self.settings.directions == "cartesian":
            return d
        theta = torch.atan2(torch.linalg.vector_norm(d[..., :2], dim=-1), d[..., 2])
        phi = torch.atan2(d[..., 1], d[..., 0]) % (2.0 * torch.pi)
        return torch.stack((theta / torch.pi, phi / (2.0 * torch.pi)), dim=-1)

    def _relative(self, positions: Tensor) -> Tensor:
        return (positions.double() - self.box_min) / self.box_side

    def cycles(self, part: str, vectors: ArrayLike) -> Tensor:
        """One input's share of Gu, in cycles reduced to [0, 1), float32 [..., features].

        part: "incident" (only where it enters with the others), "positions" or "outgoing"; the shares add up to Gu
        modulo 1.
        """
        values = _float64(vectors, self.frequencies.device)
        across = self.settings.across
        before = 0 if self.settings.trunk else across
        columns = {
            "incident": (0, before),
            "positions": (before, before + 3),
            "outgoing": (before + 3, before + 3 + across),
        }
        first, last = columns[part]
        u = self._relative(values) if part == "positions" else self._scale(values)
        return ((u @ self.frequencies[:, first:last].double().T) % 1.0).float()

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3] in 1/sr, float32: incident [D,3] shared by all queries or [N,D,3], positions [N,3], outgoing [N,3].

        The plain path, through `radiance`; the reference for `evaluate_block`.
        """
        at = self.frequencies.device
        x, eye, light = (_float64(vectors, at) for vectors in (positions, outgoing, incident))
        count = x.shape[0]
        light = light.expand(count, *light.shape[-2:]) if light.ndim == 2 else light
        directions = light.shape[1]
        answer = np.empty((count, directions, 3), dtype=np.float32)
        across = min(directions, ROWS_PER_BATCH)
        queries = max(1, ROWS_PER_BATCH // max(1, across))
        with torch.inference_mode():
            for n in range(0, count, queries):
                some = slice(n, n + queries)
                for d in range(0, directions, across):
                    radiance = self.radiance(light[some, d : d + across], x[some], eye[some])
                    answer[some, d : d + across] = radiance.float().cpu().numpy()
        return answer

    def prepared(self, precision: str = "float32", device: str = "cpu") -> FusedNetwork:
        """A frozen copy with the fused `evaluate_block`; precision ("float32", "bfloat16") is the matrix work's."""
        return prepared_for(self, precision, device)

    def evaluate_block(
        self, incident: ArrayLike, rotation: ArrayLike, positions: ArrayLike, outgoing: ArrayLike
    ) -> NDArray[np.float32]:
        """Ŝ [N,B,D,3]: bin (n, b) is lit from incident[rotation[n, b]]; see `FusedNetwork.evaluate_block`."""
        return self.prepared(device=str(self.frequencies.device)).evaluate_block(
            incident, rotation, positions, outgoing
        )


def _float64(vectors: ArrayLike | Tensor, device: torch.device) -> Tensor:
    if isinstance(vectors, Tensor):
        return vectors.detach().to(device, torch.float64)
    # A copy: the array may be read-only, of which torch tensors know nothing.
    return torch.from_numpy(np.array(vectors, dtype=np.float64)).to(device)


def save_model(network: NeuralBSSRDF, path: str | Path) -> None:
    """Writes the network as `.pt` or `.safetensors`: tensors in float16 where that loses nothing (`rounded`), else in
    float32; everything else as JSON.

    As a trainer rounds them the paper's takes 372 KiB and the measured one 660 KiB at most. Raises ModelError on
    another suffix or on weights that are not finite, StorageError if the file cannot be written; an older file then
    stays as it was.
    """
    head = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "settings": network.settings.as_json(),
        "box_min": network.box_min.tolist(),
        "box_side": network.box_side,
        "output_scale": network.output_scale,
        "metadata": network.metadata,
    }
    if network.view is not None:
        head["interior"] = network.view.interior.as_json()
    tensors = {name: tensor.detach().float().cpu().contiguous() for name, tensor in network.state_dict().items()}
    refuse_unsound(tensors, _shapes(tensors), path)
    tensors = {name: _smallest(tensor) for name, tensor in tensors.items()}
    if network.view is not None:
        tensors[INTERIOR] = network.view.interior.packed()
    write_checkpoint(path, json.dumps(head), tensors)


def _smallest(tensor: Tensor) -> Tensor:
    half = tensor.half()
    return half if bool((half.float() == tensor).all()) else tensor


def load_model(path: str | Path, device: str = "cpu") -> NeuralBSSRDF:
    """The network that `save_model` wrote, ready to evaluate on `device`.

    Nothing in the file is run: only plain tensors and JSON are accepted. Raises ModelError naming the file and the
    tensor or key at fault.
    """
    text, tensors = read_checkpoint(path)
    try:
        head = json.loads(text)
        if head["format"] != FORMAT or head["format_version"] != FORMAT_VERSION:
            raise ModelError(
                f"{path}: expected {FORMAT!r} version {FORMAT_VERSION}, "
                f"found {head['format']!r} version {head['format_version']!r}"
            )
        packed = tensors.pop(INTERIOR, None)
        network = NeuralBSSRDF(
            NetworkSettings.from_json(head["settings"]),
            head["box_min"],
            head["box_side"],
            head["output_scale"],
            head["metadata"],
            None if packed is None else Interior.unpacked(head["interior"], packed),
        )
    except ModelError as fault:
        raise fault if str(path) in str(fault) else ModelError(f"{path}: {fault}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as fault:
        raise ModelError(f"{path}: the model's description is not readable ({fault!r}); write it anew") from None
    refuse_unsound(tensors, _shapes(network.state_dict()), path)
    network.load_state_dict(tensors)
    return network.to(device).eval()


def _shapes(tensors: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}
