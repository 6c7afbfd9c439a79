"""Fits layers that correct the values of a network by its low bands.

They predict c_lm, the low bands less the coefficients of the values, and Σ c_lm Y_lm(ωi) is added to the values. Both
are the network's own, so nothing is path traced. The coefficients of the values are sums over a lattice of incident
directions that is turned at random: the layers average over its errors. The sums take most of the time, so new views
are computed until half of it is over, and then used again.
"""

import copy
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.lobes import evaluate_lobes
from prt_bake.network.low_bands import LOW_DEGREE, correction_of, low_harmonics
from prt_bake.trainer.learning.learner import LearningSettings, rotated_lattice
from prt_bake.trainer.learning.low_bands import Follow, fit_layers, orders
from prt_bake.trainer.learning.objective import low_loss
from prt_bake.trainer.learning.prefetch import in_advance
from prt_bake.trainer.learning.view_features import Views, encoded_views
from prt_bake.trainer.samples.traced import Traced

SHARE_OF_TIME = 0.1
"""Of the time of learning, in runs that end by time."""
STEPS_A_STEP = 1
"""Steps for each step of the other layers, in runs that end by steps."""
_WIDTH = 96
"""Of the layers. With 64 they err by a third more than with 128 after equal steps; wider ones make larger files."""
_MOST_STEPS = 20_000
_DIRECTIONS = 64
_MOST_VIEWS = 1 << 20
"""Views that are kept, of some 1.3 kB each: together no more than the low bands have needed before."""
_NEW = 0.5
"""Share of the fit in which views are new."""
_TURN_STREAM = 0xC0


def fit_correction(
    network: NeuralBSSRDF,
    queries: Traced,
    settings: LearningSettings,
    seed: int,
    threads: int,
    *,
    steps: int | None = None,
    seconds: float = math.inf,
    follow: Follow = lambda share: None,
) -> None:
    """Give `network`, which has low bands, layers that correct its values, fitted in `steps` or for `seconds`.

    The views are those of `queries`. seed: of the layers, the order of the views, and the directions; threads: that
    encode views. The network stays as it was if `follow`, which is called with the share that is over, raises, and if
    the fit was too short to gain anything at new views.
    """
    settings = replace(settings, batch=min(settings.low_batch, len(queries.views)))
    generator = torch.Generator().manual_seed(seed)
    layers = correction_of(replace(network.settings, correction_width=_WIDTH), generator)
    assert layers is not None
    layers.to(network.box_min.device)
    average, share = copy.deepcopy(layers), 0.0
    turns = np.random.default_rng((_TURN_STREAM, seed))

    def watch(over: float) -> None:
        nonlocal share
        share = over
        follow(over)

    def batches(new: Iterator[Views]) -> Iterator[tuple[Tensor, Tensor]]:
        known = list[tuple[Tensor, Tensor]]()
        while not known or (share < _NEW and len(known) * settings.batch < _MOST_VIEWS):
            inputs, targets = _differences(network, next(new), turns)
            known.append((inputs.half(), targets))
            yield inputs, targets
        while True:
            inputs, targets = known[turns.integers(len(known))]
            yield inputs.float(), targets

    chosen = orders(len(queries.views), settings.batch, seed)
    new = in_advance(lambda some: encoded_views(network, queries, some), chosen, threads)
    try:
        fit_layers(layers, average, batches(new), settings, steps or _MOST_STEPS, seconds, watch)
        inputs, targets = _differences(network, next(new), turns)
    finally:
        new.close()
    with torch.no_grad():
        gains = low_loss(average(inputs), targets).sum() < low_loss(torch.zeros_like(targets), targets).sum()
    if gains:
        network.set_correction(average)


@torch.no_grad()
def _differences(network: NeuralBSSRDF, views: Views, turns: np.random.Generator) -> tuple[Tensor, Tensor]:
    """The inputs [N,·] of the correction, and the low bands less those of the values [N,9,3] over the output scale."""
    features = network.view_features(*views)
    inputs = torch.cat((features, network.trunk_outputs(features[:, None])[-1][:, 0]), dim=-1)
    incident = torch.from_numpy(rotated_lattice(len(features), _DIRECTIONS, turns)).to(features.device)
    values, lobes = network.components(incident, *views)
    if lobes is not None:
        values = values + evaluate_lobes(lobes, incident, LOW_DEGREE)
    of_values = (4.0 * math.pi / _DIRECTIONS) * torch.einsum("ndk,ndc->nkc", low_harmonics(incident), values)
    assert network.low is not None
    return inputs, network.low(features) - of_values
