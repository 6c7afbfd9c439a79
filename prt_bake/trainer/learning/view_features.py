"""The features of the views of traced queries, kept from the first pass over the queries for the following ones.

To compute them takes three times as long as to learn from them.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.trainer.samples.rows import OUTGOING, POSITION
from prt_bake.trainer.samples.traced import Traced

MOST_KEPT = 1 << 21
"""Queries whose features are kept, of some 1 kB each. Those of others are computed whenever they are used."""


class Views(NamedTuple):
    """Positions [N,3] and outgoing directions [N,3] in the scene's units, and their encoding."""

    positions: Tensor
    outgoing: Tensor
    encoding: Any


def encoded_views(network: NeuralBSSRDF, queries: Traced, chosen: Tensor) -> Views:
    """The views of the queries `chosen`, on the network's device."""
    views = queries.views[chosen].to(network.box_min.device)
    positions = network.box_min + network.box_side * views[:, POSITION].double()
    return Views(positions, views[:, OUTGOING], network.encode_views(positions, views[:, OUTGOING]))


class EncodedBatch(NamedTuple):
    """Numbers [N] of queries, which of them are new [N], and the views of these."""

    chosen: Tensor
    new: Tensor
    views: Views | None


class KeptFeatures:
    """The inputs of a network's first layer, for queries.

    They are rounded to float16 even if they are not kept, so that no result depends on which ones are.
    """

    def __init__(self, network: NeuralBSSRDF, queries: Traced, most: int = MOST_KEPT) -> None:
        """Keep the features of the first `most` queries as soon as they have been used."""
        self._network, self._queries = network, queries
        self._device = network.box_min.device
        self._kept = torch.empty(
            min(len(queries.views), most), network.settings.view_inputs, dtype=torch.float16, device=self._device
        )
        self._known = torch.zeros(len(queries.views), dtype=torch.bool)

    def encode(self, chosen: Tensor) -> EncodedBatch:
        """The views of those of the queries `chosen` whose features are not kept yet; safe in any thread."""
        new = ~self._known[chosen]
        views = encoded_views(self._network, self._queries, chosen[new]) if new.any() else None
        return EncodedBatch(chosen, new, views)

    @torch.no_grad()
    def of(self, batch: EncodedBatch) -> Tensor:
        """The features [N,inputs] of a batch, float32."""
        chosen, new, views = batch
        features = torch.empty(len(chosen), self._kept.shape[1], dtype=torch.float16, device=self._device)
        features[~new] = self._kept[chosen[~new]]
        if views is not None:
            features[new] = self._network.view_features(*views).half()
            fits = new & (chosen < len(self._kept))
            self._kept[chosen[fits]] = features[fits]
            self._known[chosen[fits]] = True
        return features.float()
