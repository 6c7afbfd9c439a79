"""Forecast of the time that a bake still takes."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from prt_bake import bake
from prt_bake.baking.job.forecast import COARSE_EXPONENT, BakeStatus, Forecast, error_exponent
from prt_bake.cli.shared.progress import in_words
from tests.bakers.transports import Incoherent, icosphere


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    now = [100.0]
    monkeypatch.setattr("prt_bake.baking.job.forecast.time.monotonic", lambda: now[0])

    def advance(seconds: float) -> None:
        now[0] += seconds

    return advance


def test_the_forecast_extrapolates_from_finished_work(clock: Callable[[float], None]) -> None:
    forecast = Forecast(np.ones(10), predicted=30.0, began=100.0)
    assert forecast.left(0) == 30.0
    clock(8.0)
    assert forecast.left(2) == pytest.approx(32.0)
    clock(2.0)
    assert forecast.left(10) == 0.0


def test_work_of_an_earlier_run_takes_no_time(clock: Callable[[float], None]) -> None:
    work = np.ones(10)
    work[:6] = 0.0
    forecast = Forecast(work, began=100.0)
    assert forecast.left(6) is None
    clock(3.0)
    assert forecast.left(7) == pytest.approx(9.0)
    assert Forecast(np.zeros(10), began=100.0).left(10) == 0.0


def test_later_passes_count_and_the_deadline_limits_the_forecast(clock: Callable[[float], None]) -> None:
    clock(4.0)
    assert Forecast(np.ones(4), after=5.0, began=100.0).left(1) == pytest.approx(12.0 + 80.0)
    assert Forecast(np.ones(4), after=5.0, began=100.0, deadline=124.0).left(1) == pytest.approx(20.0)
    assert Forecast(np.ones(4), after=math.inf, began=100.0, deadline=124.0).left(1) == pytest.approx(20.0)
    assert Forecast(np.ones(4), after=math.inf, began=100.0).left(1) is None
    clock(100.0)
    assert Forecast(np.ones(4), after=5.0, began=100.0, deadline=124.0).left(1) == 0.0


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_the_error_exponent_is_fitted_to_the_passes(power: float) -> None:
    errors = [0.2, 0.1, 0.02]
    seconds = np.cumsum([error**-power for error in errors])
    rows = [(float(taken), 0.0, error) for taken, error in zip(seconds, errors, strict=True)]
    assert error_exponent(rows) == pytest.approx(power)


def test_one_pass_gives_the_default_exponent() -> None:
    assert error_exponent([]) == error_exponent([(1.0, 1.0, 0.1)]) == COARSE_EXPONENT
    assert error_exponent([(1.0, 1.0, 0.1), (2.0, 2.0, 0.1)]) == COARSE_EXPONENT


@pytest.mark.parametrize("arguments", [{"samples": 36}, {"error": 0.05}])
def test_a_bake_reports_the_time_left_until_its_end(
    arguments: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 64)
    reported: list[tuple[int, BakeStatus]] = []
    bake(
        Incoherent(),
        icosphere(1),
        rings=4,
        sectors=16,
        **arguments,
        progress=lambda done, total, row: reported.append((done, row)),
    )
    assert all(row.left is not None and row.left >= 0.0 for _done, row in reported)
    assert reported[-1][1].left == 0.0
    assert [done for done, _row in reported][-1] == 42
    seconds, _evaluations, error = reported[-1][1]
    assert seconds > 0.0
    assert error > 0.0


def test_times_are_printed_in_suitable_units() -> None:
    assert [in_words(seconds) for seconds in (0.2, 99.4, 200.0, 3599.6, 7500.0)] == [
        *("0 s", "99 s", "3:20 min"),
        *("1:00 h", "2:05 h"),
    ]
