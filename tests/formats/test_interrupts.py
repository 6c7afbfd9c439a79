"""Ctrl-C waits until the block ends and then arrives, whoever handles it; or is only noticed."""

import signal
import threading

import pytest

from formats.interrupts import deferred, noticed


def test_an_interrupt_waits_for_the_end_of_the_block():
    steps = []

    def work() -> None:
        with deferred():
            signal.raise_signal(signal.SIGINT)
            steps.append("went on")
        steps.append("never reached")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert steps == ["went on"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_the_program_gets_it_afterwards():
    seen = []
    before = signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        with deferred():
            signal.raise_signal(signal.SIGINT)
            assert seen == []
        assert seen == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_are_left_alone():
    reached = []

    def work() -> None:
        with deferred():
            reached.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert reached == [signal.default_int_handler]


def test_an_interrupt_that_is_only_noticed_stops_nothing():
    with noticed() as asked:
        assert not asked()
        signal.raise_signal(signal.SIGINT)
        assert asked()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_other_threads_notice_nothing_and_change_nothing():
    reached = []

    def work() -> None:
        with noticed() as asked:
            reached.append((asked(), signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert reached == [(False, signal.default_int_handler)]
