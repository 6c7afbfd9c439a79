"""Kernels on several threads: every row is computed once, slices run concurrently, and errors are raised."""

import threading

import numba
import numpy as np
import pytest

from prt_bake.jit import threads
from prt_bake.jit.threads import in_threads


@pytest.fixture(params=[1, 2, 5])
def several(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """The number of threads, independent of the machine."""
    monkeypatch.setattr(threads, "get_num_threads", lambda: request.param)
    return int(request.param)


@pytest.mark.parametrize("least", [1, 7])
@pytest.mark.parametrize("rows", [0, 1, 3, 13, 1000])
def test_every_row_is_in_one_slice_and_none_is_too_short(several: int, rows: int, least: int) -> None:
    seen, slices = np.zeros(rows, int), []

    def kernel(begun: int, ended: int, rows_seen: np.ndarray) -> None:
        slices.append(ended - begun)
        rows_seen[begun:ended] += 1

    in_threads(kernel, rows, seen, least=least)
    assert (seen == 1).all()
    assert sum(size < least for size in slices) <= 1
    assert several == 1 or rows < 100 or len(slices) > several


def test_slices_run_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "get_num_threads", lambda: 3)
    together = threading.Barrier(3, timeout=600)
    in_threads(lambda begun, ended: together.wait(), 3)


def test_an_exception_of_a_slice_is_raised_after_all_threads_have_ended(several: int) -> None:
    running = []

    def kernel(begun: int, ended: int) -> None:
        running.append(begun)
        try:
            if begun <= 50 < ended:
                raise ZeroDivisionError(begun)
        finally:
            running.remove(begun)

    with pytest.raises(ZeroDivisionError):
        in_threads(kernel, 100)
    assert not running


def test_no_more_threads_run_than_numba_allows() -> None:
    most, seen = numba.get_num_threads(), set()
    numba.set_num_threads(1)
    try:
        in_threads(lambda begun, ended: seen.add(threading.get_ident()), 100)
    finally:
        numba.set_num_threads(most)
    assert seen == {threading.get_ident()}
