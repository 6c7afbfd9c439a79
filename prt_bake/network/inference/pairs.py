"""The fast way through a frozen network in a picture: each view is lit from directions of its own.

Rows are taken in tiles of one fixed size that stay in cache; a result does not depend on how views are batched.
"""

import hashlib
import json
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.errors import QueryError
from prt_bake.network.features.pair_kernel import cycles_rows, fourier_rows
from prt_bake.network.inference.fused import FusedNetwork
from prt_bake.network.lobes import evaluate_lobes

if TYPE_CHECKING:
    from prt_bake.network.bssrdf import NeuralBSSRDF

Array = NDArray[np.float64]


class PairTransport(Protocol):
    """Answers Ŝ for points with directions of their own."""

    def evaluate_pairs(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.floating]:
        """Ŝ [N,S,3] in 1/sr: incident [N,S,3], positions [N,3], outgoing [N,3]."""


def pair_transport(network: Any, precision: str = "float32", device: str = "cpu") -> Any:
    """A network in its fast form; anything else that has `evaluate` as it is, in float32 on the CPU.

    Raises QueryError where there is no `evaluate`, and for another precision or device without a fast form.
    """
    from prt_bake.network.bssrdf import NeuralBSSRDF

    if isinstance(network, NeuralBSSRDF):
        return PairNetwork(network, precision, device)
    if not hasattr(network, "evaluate"):
        raise QueryError(f"{type(network).__name__}: has no evaluate(incident[N,D,3], positions[N,3], outgoing[N,3])")
    if precision != "float32" or device != "cpu":
        raise QueryError(
            f"{type(network).__name__} can only be rendered with precision float32 on the cpu, "
            f"asked for {precision} on {device}: those are for prtbake's own networks"
        )
    return _Plain(network)


def content_hash(network: Any) -> str:
    """SHA-256 of what decides a network's answers; of its name, where that cannot be told."""
    digest = hashlib.sha256(type(network).__name__.encode())
    if isinstance(network, torch.nn.Module):
        numbers = [getattr(network, name, None) for name in ("box_side", "output_scale")]
        view = getattr(network, "view", None)
        numbers.append(None if view is None else view.interior.content_hash)
        corner = getattr(network, "box_min", np.empty(0))
        corner = np.asarray(corner.cpu() if isinstance(corner, Tensor) else corner)
        digest.update(json.dumps([numbers, corner.tolist()]).encode())
        for name, tensor in sorted(network.state_dict().items()):
            digest.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


class _Plain:
    """Anything with `evaluate`."""

    def __init__(self, transport: Any) -> None:
        self._transport = transport

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.floating]:
        return np.asarray(self._transport.evaluate(incident, positions, outgoing))

    evaluate_pairs = evaluate


class PairNetwork(FusedNetwork):
    """A frozen network that answers Ŝ for views with directions of their own; safe to call from several threads."""

    def __init__(self, network: "NeuralBSSRDF", precision: str = "float32", device: str = "cpu") -> None:
        """Copies the weights to `device` in `precision`, as `FusedNetwork`."""
        super().__init__(network, precision, device)
        settings, frequencies = network.settings, network.frequencies.detach().double().cpu()
        self._mean = settings.feature_mean
        self._across = 0 if settings.trunk else settings.across  # inputs that a direction of incidence enters by
        deviation = np.zeros((3, settings.features), np.float32)
        deviation[: self._across] = (frequencies[:, : self._across].T - self._mean).numpy()
        self._deviation = deviation
        self._view_frequencies = np.ascontiguousarray(frequencies[:, self._across :].T.numpy())

    def evaluate_pairs(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.float32]:
        """Ŝ [N,S,3] in 1/sr, float32: incident [N,S,3], positions [N,3], outgoing [N,3].

        Agrees with `evaluate` to about 10⁻⁵ of the output's size in float32, 10⁻² in bfloat16.
        """
        count, directions = incident.shape[:2]
        answer = np.empty((count, directions, 3), np.float32)
        tile = max(1, self._rows // max(1, directions))
        with torch.inference_mode():
            for first in range(0, count, tile):
                chosen = slice(first, min(first + tile, count))
                query = incident[chosen], positions[chosen], outgoing[chosen], tile
                if self._late is None:
                    radiance = self._layers(self._feature_rows(*query).to(self._dtype))
                else:
                    radiance = self._late_radiance(*query)
                radiance = radiance.float() * self.network.output_scale
                answer[chosen] = radiance.view(tile, directions, 3)[: len(answer[chosen])].cpu().numpy()
        return answer

    def _feature_rows(self, incident: Array, positions: Array, outgoing: Array, tile: int) -> Tensor:
        """Fourier features [tile·S, 2F] of views [n ≤ tile] and their directions; the rows of no view hold zeros."""
        count, directions = incident.shape[:2]
        scaled = [self.network._scale(torch.as_tensor(part)) for part in (incident, outgoing)]
        light, view = scaled[0], torch.cat((self._relative(positions), scaled[1]), dim=-1)
        common = (light.sum(dim=-1) * self._mean) % 1.0
        if self._device.type != "cpu":
            return self._rows_there(light, view, common, tile)
        cycles = np.empty((count, self._deviation.shape[1]), np.float32)
        cycles_rows(np.ascontiguousarray(view.numpy()), self._view_frequencies, cycles)
        along = np.zeros((count, directions, 3), np.float32)
        along[..., : self._across] = light.numpy()
        rows = torch.empty((tile * directions, 2 * self._deviation.shape[1]))
        rows[count * directions :] = 0.0
        fourier_rows(cycles, along, common.numpy().astype(np.float32), self._deviation, rows.numpy())
        return rows

    def _late_radiance(self, incident: Array, positions: Array, outgoing: Array, tile: int) -> Tensor:
        """Ŝ [tile·S, 3] over the output scale; rows of no view hold anything."""
        assert self._late is not None
        at, count = self._device, len(positions)
        views = torch.zeros((tile, self.network.settings.view_inputs), device=at)
        frame = torch.zeros((tile, self.network.settings.frame_rows, 3), device=at)
        views[:count], frame[:count] = self.view_rows(torch.as_tensor(positions), torch.as_tensor(outgoing))
        bins, lobes = self._late.bins(views)
        towards = torch.zeros((tile, *incident.shape[1:]), dtype=torch.float64)
        towards[:count] = torch.as_tensor(incident)
        light = self._late.light_table(self.network.light_features(towards.to(at)))
        eye = torch.zeros((tile, 3))
        eye[:count] = torch.as_tensor(outgoing)
        eye, towards = eye.to(at), towards.to(at)
        smooth = self._late.radiance(self._late.add_views(light, bins, self.network.pair_features(towards, eye, frame)))
        return smooth if lobes is None else smooth.float() + evaluate_lobes(lobes, towards).flatten(0, 1)

    def _rows_there(self, light: Tensor, view: Tensor, common: Tensor, tile: int) -> Tensor:
        """As `_feature_rows`, on the device."""
        at = self._device
        cycles = (view.to(at) @ torch.from_numpy(self._view_frequencies).to(at)) % 1.0
        deviation = torch.from_numpy(self._deviation[: self._across]).to(at)
        phase = cycles.float()[:, None] + common.to(at).float()[..., None] + light.to(at).float() @ deviation
        phase = (2.0 * torch.pi) * phase.flatten(0, 1)
        rows = torch.zeros((tile * light.shape[1], 2 * phase.shape[1]), device=at)
        rows[: len(phase)] = torch.cat((phase.cos(), phase.sin()), dim=-1)
        return rows

    def _relative(self, positions: Array) -> Tensor:
        return (torch.as_tensor(positions) - self.network.box_min.cpu()) / self.network.box_side
