"""Ctrl-C and SIGTERM are deferred to the end of a block, or set a flag."""

import signal
import threading

import pytest

from formats.interrupts import deferred, interrupt_flag


def test_an_interrupt_waits_for_the_end_of_the_block():
    steps = []

    def work() -> None:
        with deferred():
            signal.raise_signal(signal.SIGINT)
            steps.append("continued")
        steps.append("never reached")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert steps == ["continued"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_previous_handler_receives_the_deferred_interrupt(number: signal.Signals):
    seen = []
    before = signal.signal(number, lambda number, frame: seen.append(number))
    try:
        with deferred():
            signal.raise_signal(number)
            assert seen == []
        assert seen == [number]
    finally:
        signal.signal(number, before)


def test_deferred_does_nothing_in_other_threads():
    reached = []

    def work() -> None:
        with deferred():
            reached.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert reached == [signal.default_int_handler]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_sets_the_flag_and_stops_nothing(number: signal.Signals):
    with interrupt_flag() as interrupted:
        assert not interrupted()
        signal.raise_signal(number)
        assert interrupted() == number
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_flag_does_nothing_in_other_threads():
    reached = []

    def work() -> None:
        with interrupt_flag() as interrupted:
            reached.append((interrupted(), signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert reached == [(False, signal.default_int_handler)]
