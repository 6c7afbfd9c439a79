"""Fast evaluation of a frozen network for pictures: every view has its own incident directions.

Rows are computed in tiles of one fixed size that stay in cache. A result does not depend on how views are batched.
"""

import hashlib
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.errors import QueryError
from formats.json_report import as_line
from prt_bake.network.core import NetworkCore
from prt_bake.network.features.fourier import encode_directions
from prt_bake.network.features.pair_kernel import cycles_rows, fourier_rows
from prt_bake.network.inference.fused import FusedNetwork
from prt_bake.network.lobes import evaluate_lobes
from prt_bake.network.low_bands import low_harmonics

Array = NDArray[np.float64]


class PairTransport(Protocol):
    """Evaluates Ŝ for points with their own incident directions."""

    def evaluate_pairs(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.floating]:
        """Ŝ [N,S,3] in 1/sr: incident [N,S,3], positions [N,3], outgoing [N,3]."""


def pair_transport(network: Any, precision: str = "float32", device: str = "cpu") -> Any:
    """A `PairTransport` of a network, or of any object with `evaluate` (in float32 on the CPU only).

    Raises QueryError if there is no `evaluate`, or if such an object is to run with another precision or device.
    """
    if isinstance(network, NetworkCore):
        return PairNetwork(network, precision, device)
    if not hasattr(network, "evaluate"):
        raise QueryError(f"{type(network).__name__}: has no evaluate(incident[N,D,3], positions[N,3], outgoing[N,3])")
    if precision != "float32" or device != "cpu":
        raise QueryError(
            f"{type(network).__name__} can only be rendered with precision float32 on the cpu, requested {precision} "
            f"on {device}: other precisions and devices need a network of prtbake"
        )
    return _PlainTransport(network)


def content_hash(network: Any) -> str:
    """SHA-256 of everything that a network's values depend on; for other objects, of the name of their class."""
    digest = hashlib.sha256(type(network).__name__.encode())
    if isinstance(network, torch.nn.Module):
        numbers = [getattr(network, name, None) for name in ("box_side", "output_scale")]
        view = getattr(network, "view", None)
        numbers.append(None if view is None else view.interior.content_hash)
        corner = getattr(network, "box_min", np.empty(0))
        corner = np.asarray(corner.cpu() if isinstance(corner, Tensor) else corner)
        digest.update(as_line([numbers, corner.tolist()]).encode())
        for name, tensor in sorted(network.state_dict().items()):
            digest.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


class _PlainTransport:
    """An object with `evaluate`, whose rows are pairs already."""

    def __init__(self, transport: Any) -> None:
        self._transport = transport

    def evaluate_pairs(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.floating]:
        return np.asarray(self._transport.evaluate(incident, positions, outgoing))


class PairNetwork(FusedNetwork):
    """A frozen network that evaluates views with their own directions; safe to call from several threads."""

    def __init__(self, network: NetworkCore, precision: str = "float32", device: str = "cpu") -> None:
        """Copies the weights to `device` in `precision`, as `FusedNetwork`."""
        super().__init__(network, precision, device)
        settings, frequencies = network.settings, network.frequencies.detach().double().cpu()
        self._mean = settings.feature_mean
        self._light_columns = 0 if settings.trunk else settings.direction_inputs  # columns of G that act on ωi
        deviation = np.zeros((3, settings.features), np.float32)
        deviation[: self._light_columns] = (frequencies[:, : self._light_columns].T - self._mean).numpy()
        self._deviation = deviation
        self._view_frequencies = np.ascontiguousarray(frequencies[:, self._light_columns :].T.numpy())

    def evaluate_pairs(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.float32]:
        """Ŝ [N,S,3] in 1/sr, float32: incident [N,S,3], positions [N,3], outgoing [N,3].

        Agrees with `evaluate` to about 10⁻⁵ of the output's size in float32, 10⁻² in bfloat16.
        """
        if self.network.only_low:
            return self._low_pairs(incident, positions, outgoing)
        count, directions = incident.shape[:2]
        result = np.empty((count, directions, 3), np.float32)
        tile = max(1, self._rows // max(1, directions))
        with torch.inference_mode():
            for first in range(0, count, tile):
                rows = slice(first, min(first + tile, count))
                query = incident[rows], positions[rows], outgoing[rows], tile
                if self._late is None:
                    radiance = self._layers(self._feature_rows(*query).to(self._dtype))
                else:
                    radiance = self._late_radiance(*query)
                radiance = radiance.float() * self.network.output_scale
                result[rows] = radiance.view(tile, directions, 3)[: len(result[rows])].cpu().numpy()
        return result

    def _low_pairs(self, incident: Array, positions: Array, outgoing: Array) -> NDArray[np.float32]:
        """As `evaluate_pairs`, for networks of low bands alone."""
        with torch.inference_mode():
            views, _frame = self.view_rows(torch.as_tensor(positions), torch.as_tensor(outgoing))
            harmonics = low_harmonics(torch.as_tensor(incident).to(self._device))
            return np.asarray(self._low_radiance(self.low_coefficients(views), harmonics).cpu().numpy())

    def _feature_rows(self, incident: Array, positions: Array, outgoing: Array, tile: int) -> Tensor:
        """Fourier features [tile·S, 2F] of views [n ≤ tile] and their directions; rows beyond n are 0."""
        count, directions = incident.shape[:2]
        form = self.network.settings.directions
        light, eye = (encode_directions(torch.as_tensor(part), form) for part in (incident, outgoing))
        view = torch.cat(
            ((torch.as_tensor(positions) - self.network.box_min.cpu()) / self.network.box_side, eye), dim=-1
        )
        common = (light.sum(dim=-1) * self._mean) % 1.0
        if self._device.type != "cpu":
            return self._feature_rows_on_device(light, view, common, tile)
        cycles = np.empty((count, self._deviation.shape[1]), np.float32)
        cycles_rows(np.ascontiguousarray(view.numpy()), self._view_frequencies, cycles)
        along = np.zeros((count, directions, 3), np.float32)
        along[..., : self._light_columns] = light.numpy()
        rows = torch.empty((tile * directions, 2 * self._deviation.shape[1]))
        rows[count * directions :] = 0.0
        fourier_rows(cycles, along, common.numpy().astype(np.float32), self._deviation, rows.numpy())
        return rows

    def _feature_rows_on_device(self, light: Tensor, view: Tensor, common: Tensor, tile: int) -> Tensor:
        """As `_feature_rows`, with tensors on the device."""
        at = self._device
        cycles = (view.to(at) @ torch.from_numpy(self._view_frequencies).to(at)) % 1.0
        deviation = torch.from_numpy(self._deviation[: self._light_columns]).to(at)
        phase = cycles.float()[:, None] + common.to(at).float()[..., None] + light.to(at).float() @ deviation
        phase = (2.0 * torch.pi) * phase.flatten(0, 1)
        rows = torch.zeros((tile * light.shape[1], 2 * phase.shape[1]), device=at)
        rows[: len(phase)] = torch.cat((phase.cos(), phase.sin()), dim=-1)
        return rows

    def _late_radiance(self, incident: Array, positions: Array, outgoing: Array, tile: int) -> Tensor:
        """Ŝ [tile·S, 3] over the output scale of n ≤ tile views; rows beyond n are undefined."""
        assert self._late is not None
        at, count = self._device, len(positions)
        views = torch.zeros((tile, self.network.settings.view_inputs), device=at)
        frame = torch.zeros((tile, self.network.settings.frame_rows, 3), device=at)
        views[:count], frame[:count] = self.view_rows(torch.as_tensor(positions), torch.as_tensor(outgoing))
        terms, lobes, correction = self._late.view_parts(views)
        directions = torch.zeros((tile, *incident.shape[1:]), dtype=torch.float64)
        directions[:count] = torch.as_tensor(incident)
        light = self._late.light_table(self.network.light_features(directions.to(at)))
        eye = torch.zeros((tile, 3))
        eye[:count] = torch.as_tensor(outgoing)
        eye, directions = eye.to(at), directions.to(at)
        pairs = self.network.pair_features(directions, eye, frame)
        radiance = self._late.radiance(self._late.add_views(light, terms, pairs))
        if lobes is not None:
            radiance = radiance.float() + evaluate_lobes(lobes, directions).flatten(0, 1)
        if correction is not None:
            radiance = radiance.float() + torch.bmm(low_harmonics(directions), correction).flatten(0, 1)
        return radiance
