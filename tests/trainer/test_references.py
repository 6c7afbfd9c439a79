"""Path-traced references within a time: fewer queries, then more walks; never biased."""

from typing import Any

import numpy as np
import pytest

from prt_bake.trainer import references
from prt_bake.trainer.references import Array, TracedReference, trace_reference

TRUTH = np.linspace(1.0, 2.0, 400)[:, None]


class Clock:
    """A clock that advances by one second per estimate of a query."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


class Walks:
    """Estimates of TRUTH with noise of relative size 1 for a walk; counts the walks of each query."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.walks = clock, np.zeros(len(TRUTH), int)
        self.seeds: list[int] = []

    def __call__(self, rows: slice, paths: int, seed: int) -> Array:
        exact = TRUTH[rows]
        self.clock.now += len(exact)
        self.walks[rows] += paths
        self.seeds.append(seed)
        return exact * np.random.default_rng(seed).gamma(paths, 1.0 / paths, exact.shape)


@pytest.fixture
def walks(monkeypatch: pytest.MonkeyPatch) -> Walks:
    clock = Clock()
    monkeypatch.setattr(references, "time", clock)
    monkeypatch.setattr(references, "_BLOCK_SECONDS", 1000.0)
    return Walks(clock)


def traced(walks: Walks, seconds: float, **more: Any) -> TracedReference:
    return trace_reference(walks, len(TRUTH), 16, seconds=seconds, predict=lambda rows: 1.1 * TRUTH[rows], **more)


@pytest.mark.parametrize("seconds", [200.0, 1500.0, 10_000.0])
def test_the_time_is_used_and_kept(walks: Walks, seconds: float) -> None:
    found = traced(walks, seconds)
    assert 0.75 * seconds < walks.clock.now <= 1.05 * seconds + 10.0
    assert found.ended == "time"
    assert (len(found) < len(TRUTH)) == (seconds < 8 * len(TRUTH))
    assert found.predicted is not None
    np.testing.assert_array_equal(found.predicted, 1.1 * TRUTH[: len(found)])


def test_a_few_queries_are_traced_without_any_time(walks: Walks) -> None:
    found = traced(walks, 0.0)
    assert (len(found), found.walks, found.ended) == (8, 4 * 16, "time")


def test_blocks_and_batches_have_their_own_random_numbers(walks: Walks) -> None:
    traced(walks, 3000.0)
    assert len(set(walks.seeds[1:])) == len(walks.seeds) - 1  # the first one loads the kernel


def test_estimates_and_their_errors_are_unbiased(walks: Walks) -> None:
    for seed in range(3):
        found = traced(walks, 2500.0, seed=seed)
        off = (found.estimates.mean - TRUTH[: len(found)]) / found.standard_error
        # Eight batches: Student's t with seven degrees of freedom has a variance of 1.4.
        assert abs(off.mean()) < 4.0 * 1.2 / np.sqrt(len(found))
        assert 0.9 < off.std() < 1.5


def test_without_a_limit_the_seeds_determine_the_result(walks: Walks) -> None:
    first, second, other = (traced(walks, np.inf, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.estimates.mean, second.estimates.mean)
    assert (first.estimates.mean != other.estimates.mean).any()
    assert first.ended == "noise"
    assert first.errors().noise.sum() <= first.errors().error.sum() / 9.0


def test_the_number_of_batches_is_limited(walks: Walks) -> None:
    found = traced(walks, np.inf, most=12, until_precise=False)
    assert (found.walks, found.ended) == (12 * 16, "size")
    assert (walks.walks == found.walks).all()


def test_an_exception_of_the_follower_ends_the_work(walks: Walks) -> None:
    shares: list[float] = []

    def interrupt(share: float) -> None:
        shares.append(share)
        if len(shares) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        traced(walks, 1000.0, follow=interrupt)
    assert shares == sorted(shares)
