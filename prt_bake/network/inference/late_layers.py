"""The layers of a frozen network whose late layers see the incident directions.

The trunk runs once per view. The contribution of a shared direction to a late layer is a row of a table. The first late
layer then costs an addition per direction, and only the layers after it cost matrix products.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from prt_bake.network.core import NetworkCore
from prt_bake.network.lobes import Lobes, decode_lobes
from prt_bake.network.settings import EXIT_INPUTS


class ViewParts(NamedTuple):
    """What late layers need of N views.

    Attributes:
        terms: contributions [layers,N,width] to the late layers, biases included.
        lobes: the lobes of the views, if there are any.
        correction: coefficients [N,9,3] of what is added to the output, if the network corrects its values.
    """

    terms: Tensor
    lobes: Lobes | None
    correction: Tensor | None


class LateLayers:
    """The weights of such a network, split by the inputs on which they act."""

    def __init__(self, network: NetworkCore, dtype: torch.dtype, linear: Any) -> None:
        """Takes the weights in `dtype`; `linear` (h, weight, bias, activation) computes the matrix products."""
        settings = network.settings
        self._trunk, self._activation, self._linear = settings.trunk, settings.activation, linear
        self._skips = [list(settings.sources(layer)) for layer in range(1, settings.layers + 1)]
        layers: list[Any] = [*network.hidden, network.output]
        self._weights = [layer.weight.detach().to(dtype) for layer in layers]
        self._biases = [layer.bias.detach().to(dtype) for layer in layers]
        of_light = [weight[:, -settings.light_inputs :] for weight in self._weights[self._trunk : -1]]
        features = 2 * settings.light_features
        self._light_weights = [weight[:, :features].contiguous() for weight in of_light]
        self.pair_weights = [weight[:, features:].T.contiguous() for weight in of_light]
        self._lobes: Any = network.lobes
        if self._lobes is not None:
            self._lobes = self._lobes.weight.detach().to(dtype), self._lobes.bias.detach().to(dtype)
        self._correction = network.correction
        self._zero = torch.zeros_like(self._biases[0])
        self._split = [self._split_weights(number) for number in range(self._trunk + 1, settings.layers + 1)]

    def _split_weights(self, number: int) -> tuple[Tensor, list[tuple[int, Tensor]]]:
        """The weights of late layer `number` that act on the trunk, and (layer, weights) of those on late layers."""
        weight = self._weights[number - 1]
        width = weight.shape[0]
        inputs = [number - 1, *self._skips[number - 1]]
        pieces = [weight[:, width * i : width * (i + 1)].contiguous() for i in range(len(inputs))]
        on_trunk = [piece for source, piece in zip(inputs, pieces, strict=True) if source <= self._trunk]
        on_late = [(source, piece) for source, piece in zip(inputs, pieces, strict=True) if source > self._trunk]
        return (torch.cat(on_trunk, dim=1) if on_trunk else weight[:, :0]), on_late

    def late_weights(self) -> list[Tensor]:
        """The weights [width,width] of late layers on late layers, for networks without skips between late layers."""
        return [weight for _on_trunk, on_late in self._split for _source, weight in on_late]

    def light_table(self, features: Tensor) -> Tensor:
        """Contributions [layers, ..., width] to the late layers of directions with features [..., 2·light_features]."""
        rows = features.to(self._zero.dtype)
        return torch.stack([torch.nn.functional.linear(rows, weight) for weight in self._light_weights])

    def view_parts(self, features: Tensor) -> ViewParts:
        """The parts of views with these inputs of the first layer [N, view_inputs]."""
        h = features.to(self._zero.dtype)
        activations: list[Tensor] = []
        for number in range(1, self._trunk + 1):
            sources = self._skips[number - 1]
            h = torch.cat((h, *(activations[source - 1] for source in sources)), dim=1) if sources else h
            h = self._linear(h, self._weights[number - 1], self._biases[number - 1], self._activation)
            activations.append(h)
        lobes = None
        if self._lobes is not None:
            lobes = decode_lobes(self._linear(h, *self._lobes, "none"), features[:, -EXIT_INPUTS:])
        correction = None
        if self._correction is not None:
            correction = self._correction(torch.cat((features.float(), h.float()), dim=1))
        terms = []
        for number, (on_trunk, _on_late) in enumerate(self._split, start=self._trunk + 1):
            sources = [source for source in (number - 1, *self._skips[number - 1]) if source <= self._trunk]
            bias = self._biases[number - 1]
            if sources:
                rows = torch.cat([activations[source - 1] for source in sources], dim=1)
                terms.append(self._linear(rows, on_trunk, bias, "none"))
            else:
                terms.append(bias.expand(len(features), -1))
        return ViewParts(torch.stack(terms), lobes, correction)

    def add_views(self, light: Tensor, views: Tensor, pairs: Tensor) -> Tensor:
        """Adds the contributions of views to those of directions [layers, N, D, width]; gives [layers, N·D, width].

        `views` [layers, N, width] are the terms of `view_parts`; `pairs` [N, D, pair_inputs] are the features of views
        and directions together. Overwrites `light`.
        """
        rows = pairs.to(self._zero.dtype).flatten(0, 1)
        for layer, part in enumerate(light):
            part += views[layer][:, None]
            part.flatten(0, 1).addmm_(rows, self.pair_weights[layer])
        return light.flatten(1, 2)

    def radiance(self, terms: Tensor) -> Tensor:
        """RGB [rows, 3] from the contributions [layers, rows, width] of views and directions; overwrites them."""
        activations: dict[int, Tensor] = {}
        h = terms[0]
        for number, (_on_trunk, on_late) in enumerate(self._split, start=self._trunk + 1):
            h = terms[number - self._trunk - 1]
            for source, weight in on_late:
                h += self._linear(activations[source], weight, self._zero, "none")
            h = h.relu_() if self._activation == "relu" else torch.nn.functional.silu(h, inplace=True)
            activations[number] = h
        return torch.as_tensor(self._linear(h, self._weights[-1], self._biases[-1], "none"))
