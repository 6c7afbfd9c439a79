"""The final error of a_lm has an interval, and is unknown where it cannot be measured."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from prt_bake.mathematics import sh
from prt_bake.mathematics.noise_free import Interval
from prt_bake.trainer import validation
from prt_bake.trainer.validation import final_errors
from tests.trainer.small_training import make_scene


class Degree2:
    """Ŝ with the coefficients `rows` [N,9,3] at N queries."""

    def __init__(self, rows: NDArray[np.float64]) -> None:
        self._rows = rows

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float64]:
        light = np.asarray(incident)
        return sh.evaluate(light.reshape(-1, 3), 2).reshape(*light.shape[:-1], 9) @ self._rows


def test_a_network_of_nothing_is_all_off(tmp_path: Path) -> None:
    errors = final_errors(Degree2(np.zeros((256, 9, 3))), make_scene(tmp_path), 256, 64)
    assert errors.coefficients == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("queries", "known"), [(4, False), (16, True)])
def test_few_queries_have_no_interval(tmp_path: Path, queries: int, known: bool) -> None:
    scene = make_scene(tmp_path)
    errors = final_errors(Degree2(np.zeros((queries, 9, 3))), scene, queries, 8)
    assert errors.coefficients == pytest.approx(1.0, abs=0.5)
    assert (errors.coefficients_interval is not None) == known
    if errors.coefficients_interval is not None:
        low, high = errors.coefficients_interval
        assert low <= errors.coefficients <= high


@pytest.mark.parametrize("high", [0.1, 0.0, float("nan")])
def test_an_error_that_the_noise_hides_is_not_zero(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, high: float
) -> None:
    """The noise is subtracted; if nothing is left, the error is at most the upper end of its interval."""
    monkeypatch.setattr(validation, "relative_rmse", lambda *_: Interval(0.0, 0.0, high))
    errors = final_errors(Degree2(np.zeros((8, 9, 3))), make_scene(tmp_path), 8, 8)
    expected = (None, 0.1, [0.0, 0.1]) if high > 0.0 else (None, None, None)
    assert (errors.transport, errors.coefficients, errors.coefficients_interval) == expected
