"""The fast way through a frozen network that sees the directions of incidence late.

The layers before are run once a bin. What a shared direction adds to a later layer is a row of a table, so that the
first of them costs an addition a direction, and only those after it a product of matrices.
"""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from prt_bake.network.lobes import Lobes, decode_lobes
from prt_bake.network.settings import EXIT_INPUTS

if TYPE_CHECKING:
    from prt_bake.network.bssrdf import NeuralBSSRDF

__all__ = ["LateLayers", "joined"]


class LateLayers:
    """The weights of a late network, split by what they act on."""

    def __init__(self, network: "NeuralBSSRDF", dtype: torch.dtype, linear: Any) -> None:
        """Takes the weights as they are, in `dtype`; `linear` (h, weight, bias, activation) does the products."""
        settings = network.settings
        self._trunk, self._activation, self._linear = settings.trunk, settings.activation, linear
        self._skips = [list(settings.sources(layer)) for layer in range(1, settings.layers + 1)]
        layers: list[Any] = [*network.hidden, network.output]
        self._weights = [layer.weight.detach().to(dtype) for layer in layers]
        self._biases = [layer.bias.detach().to(dtype) for layer in layers]
        told = [weight[:, -settings.light_inputs :] for weight in self._weights[self._trunk : -1]]
        features = 2 * settings.light_features
        self._light = [weight[:, :features].contiguous() for weight in told]
        self.pair_weights = [weight[:, features:].T.contiguous() for weight in told]
        self._lobes: Any = network.lobes
        if self._lobes is not None:
            self._lobes = self._lobes.weight.detach().to(dtype), self._lobes.bias.detach().to(dtype)
        self._zero = torch.zeros_like(self._biases[0])
        self._split = [self._columns(number) for number in range(self._trunk + 1, settings.layers + 1)]

    def _columns(self, number: int) -> tuple[Tensor, list[tuple[int, Tensor]]]:
        """Of a layer that sees ωi: what acts once a bin, and (layer, weight) of what acts on each direction's own."""
        weight = self._weights[number - 1]
        width = weight.shape[0]
        inputs = [number - 1, *self._skips[number - 1]]
        pieces = [weight[:, width * i : width * (i + 1)].contiguous() for i in range(len(inputs))]
        shared = [piece for source, piece in zip(inputs, pieces, strict=True) if source <= self._trunk]
        own = [(source, piece) for source, piece in zip(inputs, pieces, strict=True) if source > self._trunk]
        return (torch.cat(shared, dim=1) if shared else weight[:, :0]), own

    def squares(self) -> list[Tensor]:
        """What acts on the directions' own, [width,width] each, of layers that are told nothing but the one before."""
        return [weight for _shared, own in self._split for _source, weight in own]

    def light_table(self, features: Tensor) -> Tensor:
        """What directions with the features [..., 2·light_features] add to each later layer [layers, ..., width]."""
        rows = features.to(self._zero.dtype)
        return torch.stack([torch.nn.functional.linear(rows, weight) for weight in self._light])

    def bins(self, features: Tensor) -> tuple[Tensor, Lobes | None]:
        """What a view adds to each later layer, biases included [layers, N, width], and its lobes; from the features
        that the first layer sees [N, view_inputs].
        """
        h = features.to(self._zero.dtype)
        activations: list[Tensor] = []
        for number in range(1, self._trunk + 1):
            sources = self._skips[number - 1]
            h = torch.cat((h, *(activations[source - 1] for source in sources)), dim=1) if sources else h
            h = self._linear(h, self._weights[number - 1], self._biases[number - 1], self._activation)
            activations.append(h)
        lobes = None if self._lobes is None else decode_lobes(self._linear(h, *self._lobes, "none"), features[:, -EXIT_INPUTS:])
        added = []
        for number, (shared, _own) in enumerate(self._split, start=self._trunk + 1):
            sources = [source for source in (number - 1, *self._skips[number - 1]) if source <= self._trunk]
            bias = self._biases[number - 1]
            if sources:
                rows = torch.cat([activations[source - 1] for source in sources], dim=1)
                added.append(self._linear(rows, shared, bias, "none"))
            else:
                added.append(bias.expand(len(features), -1))
        return torch.stack(added), lobes

    def add_views(self, added: Tensor, bins: Tensor, pairs: Tensor) -> Tensor:
        """`added` [layers, N, D, width], of directions, with what views add to it: `bins` [layers, N, width] of them
        alone, `pairs` [N, D, pair_inputs] of them and directions. Overwrites it; gives [layers, N·D, width].
        """
        rows = pairs.to(self._zero.dtype).flatten(0, 1)
        for layer, part in enumerate(added):
            part += bins[layer][:, None]
            part.flatten(0, 1).addmm_(rows, self.pair_weights[layer])
        return added.flatten(1, 2)

    def radiance(self, added: Tensor) -> Tensor:
        """RGB [rows, 3] from what bins and directions add to each later layer [layers, rows, width]; overwrites it."""
        activations: dict[int, Tensor] = {}
        h = added[0]
        for number, (_shared, own) in enumerate(self._split, start=self._trunk + 1):
            h = added[number - self._trunk - 1]
            for source, weight in own:
                h += self._linear(activations[source], weight, self._zero, "none")
            h = h.relu_() if self._activation == "relu" else torch.nn.functional.silu(h, inplace=True)
            activations[number] = h
        return torch.as_tensor(self._linear(h, self._weights[-1], self._biases[-1], "none"))


def joined(layer: Any, parts: list[Tensor]) -> Tensor:
    """The layer's answer to the concatenation of `parts`, [N,1,·] and [N,D,·]; what is shared by the D is done once."""
    if len({part.shape[1] for part in parts}) == 1:
        return torch.as_tensor(layer(torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]))
    columns = layer.weight.split([part.shape[-1] for part in parts], dim=1)
    shared = [(part, weight) for part, weight in zip(parts, columns, strict=True) if part.shape[1] == 1]
    own = [(part, weight) for part, weight in zip(parts, columns, strict=True) if part.shape[1] > 1]
    once, each = (
        torch.nn.functional.linear(*(torch.cat(group, dim=-1) for group in zip(*kind, strict=True)))
        for kind in (shared, own)
    )
    result: Tensor = once + (each + layer.bias)
    return result
