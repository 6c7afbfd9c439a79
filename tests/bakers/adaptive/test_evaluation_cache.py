"""What was evaluated before is not asked for again, and nothing but the count of evaluations shows it."""

import pickle

import numpy as np
import pytest
from numpy.typing import NDArray

from bakers.adaptive import evaluation_cache
from bakers.adaptive.evaluation_cache import Answers
from prt_bake import bake
from prt_bake.baking.adaptive import tolerances
from tests.bakers.transports import Array, Counting, Lobed, icosphere

BINS = 8


class Asked:
    """Answers with the place itself, and keeps a list of what it was asked for."""

    def __init__(self, vertices: NDArray[np.int64], bins: NDArray[np.int64]) -> None:
        self.vertices, self.bins, self.places = vertices, bins, list[int]()

    def __call__(self, some: NDArray[np.int64]) -> Array:
        self.places += some.tolist()
        key = self.vertices[some] * BINS + self.bins[some]
        return np.stack([key, np.sqrt(key)], axis=1)


def given(known: Answers, name: str, vertices: list[int], bins: list[int]) -> tuple[Array, int, list[int]]:
    ask = Asked(np.array(vertices), np.array(bins))
    rows, recalled = known.given(name, ask.vertices, ask.bins, ask)
    np.testing.assert_array_equal(rows, Asked(ask.vertices, ask.bins)(np.arange(len(vertices))))
    return rows, recalled, ask.places


def test_only_what_is_not_known_is_asked_for() -> None:
    known = Answers(np.array([3, 5]), BINS)
    assert given(known, "a", [3, 4, 5], [0, 0, 7])[1:] == (0, [0, 1, 2])
    # Vertex 4 is not among those that are remembered.
    assert given(known, "a", [5, 4, 3, 3], [7, 0, 1, 0])[1:] == (2, [1, 2])
    assert given(known, "a", [3, 3, 5], [0, 1, 7])[1:] == (3, [])
    assert given(known, "b", [3], [0])[1:] == (0, [0])
    assert given(Answers(np.zeros(0, np.int64), 0), "a", [3, 4], [0, 1])[1:] == (0, [0, 1])


def test_many_rows_come_back_as_they_were_given() -> None:
    numbers = np.random.default_rng(1)
    known, asked = Answers(np.arange(40), BINS), set[tuple[int, int]]()
    for _round in range(30):
        keys = numbers.choice(50 * BINS, 60, replace=False)
        vertices, bins = (part.tolist() for part in np.divmod(keys, BINS))
        _rows, recalled, places = given(known, "a", vertices, bins)
        here = {(v, b) for v, b in zip(vertices, bins, strict=True) if v < 40}
        assert recalled == len(here & asked)
        assert len(places) == 60 - recalled
        asked |= here


def test_no_more_is_kept_than_there_is_room_for() -> None:
    known = Answers(np.arange(4), BINS, most_bytes=100)
    given(known, "a", [0, 1], [0, 0])
    given(known, "a", [0, 1, 2, 3], [1, 1, 1, 1])
    assert given(known, "a", [0, 1], [0, 0])[1] == 2
    assert given(known, "a", [0, 1], [1, 1])[1] == 0


def test_copies_begin_empty() -> None:
    known = Answers(np.array([3, 5]), BINS)
    given(known, "a", [3], [0])
    copy = pickle.loads(pickle.dumps(known))
    assert given(copy, "a", [3], [0])[1] == 0
    assert given(copy, "a", [3], [0])[1] == 1


def test_a_bake_is_the_same_bits_with_and_without(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, counted, forgetful = icosphere(1), Counting(Lobed()), Counting(Lobed())
    asset = bake(counted, mesh, rings=8, sectors=32, error=0.02)
    monkeypatch.setattr(tolerances, "Answers", lambda _vertices, _bins: evaluation_cache.NOTHING)
    other = bake(forgetful, mesh, rings=8, sectors=32, error=0.02)
    np.testing.assert_array_equal(asset.coefficients, other.coefficients)
    np.testing.assert_array_equal(asset.standard_error, other.standard_error)
    assert counted.evaluations == asset.provenance["evaluations"] < 0.9 * forgetful.evaluations
    assert forgetful.evaluations == other.provenance["evaluations"]
