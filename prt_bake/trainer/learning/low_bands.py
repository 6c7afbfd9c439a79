"""Fits the low bands of a network to all queries that its training has traced, in several passes.

A query gives an unbiased estimate of its a_lm: the mean of T · Y_lm over the exits of all its walks. Tracing it takes
longer than learning from it, so each is used several times. All queries are used equally often while the rate falls,
which needs all of them to be known before: passes over those of a moving window learn much less
(`docs/measurements/low_bands.md`).
"""

import copy
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.low_bands import LowBands
from prt_bake.trainer.learning.learner import (
    Learner,
    LearningSettings,
    descend,
    learning_rate,
    move_average,
    optimizers_of,
    share_of_average,
)
from prt_bake.trainer.learning.objective import low_loss
from prt_bake.trainer.learning.prefetch import in_advance
from prt_bake.trainer.learning.view_features import EncodedBatch, KeptFeatures
from prt_bake.trainer.samples.rows import Batch, RowSource
from prt_bake.trainer.samples.traced import Traced

SHARE_OF_TIME = 0.3
"""Of the time of learning, in runs that end by time."""
STEPS_A_STEP = 4
"""Steps for each step of the other layers, in runs that end by steps."""
Follow = Callable[[float], None]
"""Called with the share of a fit that is over; may raise to end it."""
_MOST_PASSES = 8
_MANY = 1 << 19
"""Queries from which on passes are twice as many, in batches twice as large, at 1.5 times the rate.

Of fewer queries the layers would learn the noise: of 150,000 they err by a seventh more.
"""
_DECAY = 0.15
"""Weight decay, against overfitting to queries that are used often."""
_ORDER_STREAM = 0x10B


def fit_low_bands(
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
    """Fit the low bands of `network`, from the weights that they have, in `steps` or for `seconds`.

    They become the running average of the fitted weights, also if `follow`, which is called with the share that is
    over, ends the fit by an exception. seed: of the order of the queries; threads: that encode views.
    """
    assert network.low is not None
    low, average = network.low, copy.deepcopy(network.low)
    count = len(queries.views)
    settings, passes = _plan(settings, count)
    most = passes * (count // settings.batch) if steps is None else steps
    features = KeptFeatures(network, queries)

    def inputs_and_targets(encoded: EncodedBatch) -> tuple[Tensor, Tensor]:
        estimates = queries.coefficients(encoded.chosen).to(network.box_min.device)
        return features.of(encoded), estimates / network.output_scale

    batches = in_advance(features.encode, orders(count, settings.batch, seed), threads)
    try:
        fit_layers(low, average, map(inputs_and_targets, batches), settings, most, seconds, follow)
    finally:
        batches.close()
        network.low = average


def _plan(settings: LearningSettings, count: int) -> tuple[LearningSettings, int]:
    """The settings of a fit to `count` queries, and how often it passes over them at most."""
    if count < _MANY:
        return replace(settings, decay=_DECAY, batch=min(settings.low_batch, count)), _MOST_PASSES
    return replace(settings, decay=_DECAY, batch=2 * settings.low_batch, rate=1.5 * settings.rate), 2 * _MOST_PASSES


def fit_layers(
    layers: LowBands,
    average: LowBands,
    batches: Iterator[tuple[Tensor, Tensor]],
    settings: LearningSettings,
    most: int,
    seconds: float,
    follow: Follow,
) -> None:
    """Fit layers to batches of inputs [N,·] and coefficients [N,9,3] in `most` steps, or for `seconds` if that is less.

    `average`, which begins with the same weights, becomes the running average.
    """
    optimizers = optimizers_of(layers, settings)
    step, begun = 0, time.perf_counter()
    while seconds > 0.0 and (share := max(step / most, (time.perf_counter() - begun) / seconds)) < 1.0:
        for group in (group for optimizer in optimizers for group in optimizer.param_groups):
            group["lr"] = learning_rate(settings, share)
        inputs, targets = next(batches)
        descend(low_loss(layers(inputs), targets).mean(), optimizers)
        step += 1
        move_average(average, layers, share_of_average(settings, step))
        follow(share)


def orders(count: int, batch: int, seed: int) -> Iterator[Tensor]:
    """Batches of the numbers 0 … count − 1 in endless passes, each in another order and without an incomplete batch."""
    number = 0
    while True:
        order = torch.from_numpy(np.random.default_rng((_ORDER_STREAM, seed, number)).permutation(count))
        for first in range(0, count - batch + 1, batch):
            yield order[first : first + batch]
        number += 1


class OnlyLowBands(Learner):
    """Leaves all other layers as they are, so that the time goes to the paths from which low bands are fitted."""

    def encode_views(self, batch: Batch) -> Any:
        """None: no layer sees the rows."""
        return None

    def learn(
        self, source: RowSource, batch: Batch, share: float, generator: np.random.Generator, encoding: Any = None
    ) -> float:
        """Count a step."""
        self.step += 1
        return 0.0
