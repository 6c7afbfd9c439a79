"""The wall time of a training run is divided among its parts, and what took too long is made up for."""

import pytest

from prt_bake.trainer import budget as module
from prt_bake.trainer.budget import Budget


class Clock:
    """A clock that is set by hand; the processor is busy for a share of the time."""

    def __init__(self) -> None:
        self.now, self.busy = 1000.0, 1.0

    def perf_counter(self) -> float:
        return self.now

    def process_time(self) -> float:
        return self.busy * self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


@pytest.mark.parametrize("minutes", [0.2, 1.0, 10.0, 100.0])
@pytest.mark.parametrize("further", [False, True])
def test_the_parts_fill_the_time(clock: Clock, minutes: float, further: bool) -> None:
    budget = Budget(minutes, report=further, importance=further)
    clock.now += budget.validation
    learning = budget.learning(0.0)
    clock.now += learning
    clock.now += budget.figures()
    clock.now += budget.report() if further else 0.0
    clock.now += budget.importance() if further else 0.0
    assert clock.now - 1000.0 == pytest.approx(60.0 * minutes)
    assert learning >= 0.5 * 60.0 * minutes
    assert budget.share == pytest.approx(1.0)


def test_longer_runs_do_not_measure_for_ever(clock: Clock) -> None:
    budget = Budget(600.0, report=True, importance=True)
    assert budget.learning(0.0) > 0.99 * 600.0 * 60.0


def test_learning_keeps_half_of_the_time_if_kernels_are_compiled(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    budget = Budget(1.0, report=True)
    monkeypatch.setattr(Budget, "compiling", 70.0)
    clock.now += 75.0
    assert budget.learning(0.0) == pytest.approx(30.0)
    clock.now += 30.0
    # The run is longer then, and what follows has its usual time.
    assert budget.figures() == pytest.approx(2.4)
    assert budget.report() == pytest.approx(9.0 + 2.4)


def test_a_busy_machine_shortens_learning_in_favour_of_what_follows(clock: Clock) -> None:
    idle, busy = (Budget(1.0, report=True, importance=True) for _ in range(2))
    clock.now += 10.0
    quiet = idle.learning(0.0)
    clock.busy = 0.0  # all of the ten seconds went to others
    assert quiet - 15.0 < busy.learning(0.0) < quiet - 5.0


def test_parts_for_which_no_time_is_left_are_left_out(clock: Clock) -> None:
    budget = Budget(1.0, report=True, importance=True)
    budget.learning(0.0)
    clock.now += 57.0
    assert budget.report() == 0.0
    assert budget.importance() > 0.0
    clock.now += 3.0
    assert budget.importance() == 0.0
    assert budget.figures() > 0.0


def test_earlier_runs_count(clock: Clock) -> None:
    budget = Budget(2.0)
    budget.earlier = 60.0
    assert 50.0 < budget.learning(30.0) < 60.0
    budget.earlier = 118.0
    assert budget.learning(110.0) == 0.0
