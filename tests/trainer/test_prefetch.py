"""Batches that are made ready while the learner learns: the same ones, told the same, learnt from alike."""

import threading
from typing import Any

import numpy as np
import pytest
import torch

from formats.errors import QueryError
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.trainer.learner import Learner
from prt_bake.trainer.prefetch import Prefetcher
from prt_bake.trainer.samples.rows import CHANNELS, INCIDENT, OUTGOING, POSITION, Batch, SourceStatistics, rays_of
from tests.network.test_feature_grid import GRIDDED
from tests.network.test_lobes import glass_ball
from tests.trainer.small_training import LEARNING, SMALL
from tests.trainer.test_learner import uniform_directions


class Numbered:
    """A source whose batch k, of 8 rows with 2 rays, depends on k alone; breaks after `last`."""

    exits = True

    def __init__(self, last: int = 1000) -> None:
        self.drawn, self.last = 0, last

    def draw(self, count: int, generator: np.random.Generator) -> Batch:
        if self.drawn >= self.last:
            raise QueryError("the source broke")
        own = np.random.default_rng(self.drawn)
        rows = np.empty((8, 18), np.float32)
        rows[:, POSITION], rows[:, OUTGOING] = own.uniform(0.3, 0.7, (8, 3)), uniform_directions(8, own)
        rays = rays_of(rows)
        rays[..., INCIDENT] = uniform_directions(16, own).reshape(8, 2, 3)
        rays[..., CHANNELS] = own.random((8, 2, 3))
        numbers = 8 * self.drawn + np.arange(8)
        self.drawn += 1
        return Batch(rows, numbers)

    def where(self, number: int) -> str:
        return f"query {number}"

    def done(self) -> SourceStatistics:
        return SourceStatistics(0, 0, 0.0)

    def state(self) -> dict[str, int]:
        return {}

    def start(self) -> None: ...

    def stop(self) -> None: ...


def a_learner() -> Learner:
    return Learner(NeuralBSSRDF(GRIDDED, interior=glass_ball(1.3)), LEARNING)


def learnt_with(threads: int, tells: bool = True) -> tuple[list[Any], Numbered]:
    learner, source, generator = a_learner(), Numbered(), np.random.default_rng(2)
    ahead = Prefetcher(source, learner, np.random.default_rng(0), threads)
    for _ in range(12):
        batch, told = ahead.draw()
        learner.learn(source, batch, 0.5, generator, told if tells else None)
    ahead.stop()
    return [weight.detach().clone() for weight in learner.network.parameters()], source


def test_what_is_learnt_does_not_depend_on_what_is_made_ready_beforehand() -> None:
    """Bit by bit, with a thread beside the learner, without, and where the learner asks for itself."""
    plain, _ = learnt_with(0, tells=False)
    for threads in (0, 1):
        weights, source = learnt_with(threads)
        assert all(torch.equal(a, b) for a, b in zip(plain, weights, strict=True))
        assert source.drawn == 12 + threads


def test_several_threads_hand_over_every_row_once_in_order() -> None:
    source = Numbered()
    ahead = Prefetcher(source, a_learner(), np.random.default_rng(0), 3)
    batches = [ahead.draw() for _ in range(40)]
    ahead.stop()
    numbers = np.concatenate([ready.batch.numbers for ready in batches])
    np.testing.assert_array_equal(numbers, np.arange(320))
    assert source.drawn <= 43
    alone = a_learner()
    for batch, told in batches[::7]:
        again = alone.told(batch)
        assert told is not None
        assert again is not None
        assert all(torch.equal(a, b) for a, b in zip(told, again, strict=True))


def test_what_was_told_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, source = a_learner(), Numbered()
    view = learner.network.view
    assert view is not None
    ahead = Prefetcher(source, learner, np.random.default_rng(0), 0)
    batch, told = ahead.draw()
    monkeypatch.setattr(view, "_told", lambda *views: pytest.fail("asked again"))
    assert np.isfinite(learner.learn(source, batch, 0.5, np.random.default_rng(2), told))


def test_no_thread_is_left() -> None:
    ahead = Prefetcher(Numbered(), a_learner(), np.random.default_rng(0), 2)
    ahead.draw()
    assert any(thread.name.startswith("prtbake-ahead") for thread in threading.enumerate())
    ahead.stop()
    assert not any(thread.name.startswith("prtbake-ahead") for thread in threading.enumerate())


@pytest.mark.parametrize("threads", [0, 1, 2])
def test_what_breaks_the_source_is_raised_where_rows_are_asked_for(threads: int) -> None:
    ahead = Prefetcher(Numbered(last=3), a_learner(), np.random.default_rng(0), threads)
    for _ in range(3 - threads):
        ahead.draw()
    with pytest.raises(QueryError, match="the source broke"):
        ahead.draw()
    ahead.stop()


def test_networks_that_are_told_nothing_beforehand_have_nothing_made_ready() -> None:
    learner = Learner(NeuralBSSRDF(SMALL, (0.0, 0.0, 0.0), 2.0), LEARNING)
    ahead = Prefetcher(Numbered(), learner, np.random.default_rng(0), 1)
    assert ahead.draw().told is None
    ahead.stop()
