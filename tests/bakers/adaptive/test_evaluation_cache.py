"""Cached values are not evaluated again, and change nothing but the number of evaluations."""

import pickle

import numpy as np
import pytest
from numpy.typing import NDArray

from bakers.adaptive import evaluation_cache
from bakers.adaptive.evaluation_cache import EvaluationCache
from prt_bake import bake
from prt_bake.baking.adaptive import tolerances
from tests.bakers.transports import Array, Counting, Lobed, icosphere

BINS = 8


class Evaluator:
    """Returns numbers that identify the place, and records the requested places."""

    def __init__(self, vertices: NDArray[np.int64], bins: NDArray[np.int64]) -> None:
        self.vertices, self.bins, self.places = vertices, bins, list[int]()

    def __call__(self, some: NDArray[np.int64]) -> Array:
        self.places += some.tolist()
        key = self.vertices[some] * BINS + self.bins[some]
        return np.stack([key, np.sqrt(key)], axis=1)


def cached(cache: EvaluationCache, name: str, vertices: list[int], bins: list[int]) -> tuple[Array, int, list[int]]:
    evaluator = Evaluator(np.array(vertices), np.array(bins))
    rows, recalled = cache.get(name, evaluator.vertices, evaluator.bins, evaluator)
    np.testing.assert_array_equal(rows, Evaluator(evaluator.vertices, evaluator.bins)(np.arange(len(vertices))))
    return rows, recalled, evaluator.places


def test_only_missing_values_are_evaluated() -> None:
    cache = EvaluationCache(np.array([3, 5]), BINS)
    assert cached(cache, "a", [3, 4, 5], [0, 0, 7])[1:] == (0, [0, 1, 2])
    # Vertex 4 is not cached.
    assert cached(cache, "a", [5, 4, 3, 3], [7, 0, 1, 0])[1:] == (2, [1, 2])
    assert cached(cache, "a", [3, 3, 5], [0, 1, 7])[1:] == (3, [])
    assert cached(cache, "b", [3], [0])[1:] == (0, [0])
    assert cached(EvaluationCache(np.zeros(0, np.int64), 0), "a", [3, 4], [0, 1])[1:] == (0, [0, 1])


def test_many_rows_are_returned_unchanged() -> None:
    numbers = np.random.default_rng(1)
    cache, evaluated = EvaluationCache(np.arange(40), BINS), set[tuple[int, int]]()
    for _round in range(30):
        keys = numbers.choice(50 * BINS, 60, replace=False)
        vertices, bins = (part.tolist() for part in np.divmod(keys, BINS))
        _rows, recalled, places = cached(cache, "a", vertices, bins)
        here = {(v, b) for v, b in zip(vertices, bins, strict=True) if v < 40}
        assert recalled == len(here & evaluated)
        assert len(places) == 60 - recalled
        evaluated |= here


def test_no_more_than_the_limit_is_stored() -> None:
    cache = EvaluationCache(np.arange(4), BINS, most_bytes=100)
    cached(cache, "a", [0, 1], [0, 0])
    cached(cache, "a", [0, 1, 2, 3], [1, 1, 1, 1])
    assert cached(cache, "a", [0, 1], [0, 0])[1] == 2
    assert cached(cache, "a", [0, 1], [1, 1])[1] == 0


def test_copies_start_empty() -> None:
    cache = EvaluationCache(np.array([3, 5]), BINS)
    cached(cache, "a", [3], [0])
    copy = pickle.loads(pickle.dumps(cache))
    assert cached(copy, "a", [3], [0])[1] == 0
    assert cached(copy, "a", [3], [0])[1] == 1


def test_a_bake_is_bitwise_equal_with_and_without_a_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, counted, uncached = icosphere(1), Counting(Lobed()), Counting(Lobed())
    asset = bake(counted, mesh, rings=8, sectors=32, error=0.02)
    monkeypatch.setattr(tolerances, "EvaluationCache", lambda _vertices, _bins: evaluation_cache.NO_CACHE)
    other = bake(uncached, mesh, rings=8, sectors=32, error=0.02)
    np.testing.assert_array_equal(asset.coefficients, other.coefficients)
    np.testing.assert_array_equal(asset.standard_error, other.standard_error)
    assert counted.evaluations == asset.provenance["evaluations"] < 0.9 * uncached.evaluations
    assert uncached.evaluations == other.provenance["evaluations"]
