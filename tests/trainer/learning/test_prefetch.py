"""Prefetching changes neither the batches nor their view encodings nor what is learnt."""

import threading
from typing import Any

import numpy as np
import pytest
import torch

from formats.errors import QueryError
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.trainer.learning.learner import Learner
from prt_bake.trainer.learning.prefetch import Prefetcher
from prt_bake.trainer.samples.rows import CHANNELS, INCIDENT, OUTGOING, POSITION, Batch, SourceStatistics, rays_of
from tests.network import WITHOUT_MESH
from tests.network.test_feature_grid import GRIDDED
from tests.network.test_lobes import glass_ball
from tests.trainer.learning.test_learner import uniform_directions
from tests.trainer.small_training import LEARNING, SMALL

pytestmark = WITHOUT_MESH


class Numbered:
    """A source whose batch k, of 8 rows with 2 rays, depends on k alone; fails after `last` batches."""

    exits = True

    def __init__(self, last: int = 1000) -> None:
        self.drawn, self.last = 0, last

    def draw(self, count: int) -> Batch:
        if self.drawn >= self.last:
            raise QueryError("the source failed")
        own = np.random.default_rng(self.drawn)
        rows = np.empty((8, 18), np.float32)
        rows[:, POSITION], rows[:, OUTGOING] = own.uniform(0.3, 0.7, (8, 3)), uniform_directions(8, own)
        rays = rays_of(rows)
        rays[..., INCIDENT] = uniform_directions(16, own).reshape(8, 2, 3)
        rays[..., CHANNELS] = own.random((8, 2, 3))
        numbers = 8 * self.drawn + np.arange(8)
        self.drawn += 1
        return Batch(rows, numbers)

    def describe(self, number: int) -> str:
        return f"query {number}"

    def statistics(self) -> SourceStatistics:
        return SourceStatistics(0, 0, 0.0)

    def state(self) -> dict[str, int]:
        return {}

    def start(self) -> None: ...

    def stop(self) -> None: ...


def make_learner() -> Learner:
    return Learner(NeuralBSSRDF(GRIDDED, interior=glass_ball(1.3)), LEARNING)


def train_with(threads: int, encode: bool = True) -> tuple[list[Any], Numbered]:
    """The weights after 12 steps with `threads` prefetching threads, and the source."""
    learner, source, generator = make_learner(), Numbered(), np.random.default_rng(2)
    prefetcher = Prefetcher(source, learner, threads)
    for _ in range(12):
        batch, encoding = prefetcher.draw()
        learner.learn(source, batch, 0.5, generator, encoding if encode else None)
    prefetcher.stop()
    return [weight.detach().clone() for weight in learner.network.parameters()], source


def test_weights_do_not_depend_on_prefetching() -> None:
    """Bit by bit: with a thread, without, and with encodings computed by the learner."""
    plain, _ = train_with(0, encode=False)
    for threads in (0, 1):
        weights, source = train_with(threads)
        assert all(torch.equal(a, b) for a, b in zip(plain, weights, strict=True))
        assert source.drawn == 12 + threads


def test_several_threads_hand_over_every_row_once_in_order() -> None:
    source = Numbered()
    prefetcher = Prefetcher(source, make_learner(), 3)
    batches = [prefetcher.draw() for _ in range(40)]
    prefetcher.stop()
    numbers = np.concatenate([prepared.batch.numbers for prepared in batches])
    np.testing.assert_array_equal(numbers, np.arange(320))
    assert source.drawn <= 43
    learner = make_learner()
    for batch, encoding in batches[::7]:
        expected = learner.encode_views(batch)
        assert encoding is not None
        assert expected is not None
        assert all(torch.equal(a, b) for a, b in zip(encoding, expected, strict=True))


def test_prefetched_encodings_are_not_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, source = make_learner(), Numbered()
    view = learner.network.view
    assert view is not None
    batch, encoding = Prefetcher(source, learner, 0).draw()
    monkeypatch.setattr(view, "_encode", lambda *views: pytest.fail("encoded again"))
    assert np.isfinite(learner.learn(source, batch, 0.5, np.random.default_rng(2), encoding))


def test_stopping_ends_all_threads() -> None:
    prefetcher = Prefetcher(Numbered(), make_learner(), 2)
    prefetcher.draw()
    assert any(thread.name.startswith("prtbake-prefetch") for thread in threading.enumerate())
    prefetcher.stop()
    assert not any(thread.name.startswith("prtbake-prefetch") for thread in threading.enumerate())


@pytest.mark.parametrize("threads", [0, 1, 2])
def test_errors_of_the_source_are_raised_when_drawing(threads: int) -> None:
    prefetcher = Prefetcher(Numbered(last=3), make_learner(), threads)
    for _ in range(3 - threads):
        prefetcher.draw()
    with pytest.raises(QueryError, match="the source failed"):
        prefetcher.draw()
    prefetcher.stop()


def test_networks_without_a_view_encoding_have_none_prefetched() -> None:
    learner = Learner(NeuralBSSRDF(SMALL, (0.0, 0.0, 0.0), 2.0), LEARNING)
    prefetcher = Prefetcher(Numbered(), learner, 1)
    assert prefetcher.draw().encoding is None
    prefetcher.stop()
