"""Features that are kept from one pass over the queries to the next."""

from typing import Any

import numpy as np
import pytest
import torch

from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.trainer.learning import view_features
from prt_bake.trainer.learning.view_features import KeptFeatures, encoded_views
from tests.network import WITHOUT_MESH
from tests.network.test_low_bands import network
from tests.trainer.learning.test_low_bands import queries

pytestmark = WITHOUT_MESH
COUNT = 40


@pytest.mark.parametrize("most", [0, 15, COUNT])
def test_kept_features_are_those_of_the_network_and_computed_once(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In whatever order the queries come, and again and again beyond the most that are kept."""
    encoded = list[int]()

    def count(made: NeuralBSSRDF, traced: Any, chosen: torch.Tensor) -> view_features.Views:
        encoded.extend(chosen.tolist())
        return encoded_views(made, traced, chosen)

    monkeypatch.setattr(view_features, "encoded_views", count)
    made, traced = network(), queries(COUNT, 1, np.random.default_rng(1))
    with torch.no_grad():
        expected = made.view_features(*encoded_views(made, traced, torch.arange(COUNT))).half().float()
    kept, orders = KeptFeatures(made, traced, most), np.random.default_rng(2)
    for _ in range(3):
        for chosen in torch.from_numpy(orders.permutation(COUNT)).split(12):
            assert torch.equal(kept.of(kept.encode(chosen)), expected[chosen])
    assert sorted(encoded) == sorted([*range(most), *3 * list(range(most, COUNT))])


def test_a_batch_that_was_encoded_before_others_were_used_has_the_same_features() -> None:
    """As threads do in advance."""
    made, traced = network(), queries(COUNT, 1, np.random.default_rng(3))
    kept, chosen = KeptFeatures(made, traced), torch.arange(COUNT)
    early = kept.encode(chosen)
    late = kept.of(kept.encode(chosen.flip(0)))
    assert torch.equal(kept.of(early), late.flip(0))
