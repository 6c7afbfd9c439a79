"""Progress on terminals of any width, and Ctrl-C."""

import io
import os
import re
import signal
import time

import pytest

from prt_bake.cli.shared.progress import as_clock, reporting, stopping


class Terminal(io.StringIO):
    """A terminal that keeps what is written."""

    def isatty(self) -> bool:
        return True


DETAILS = "step 224 · loss 0.2302 · 1,362 queries/s · 13,000 paths/s"


@pytest.mark.parametrize(
    ("columns", "bar", "detailed"),
    [(40, False, False), (60, False, False), (80, True, False), (120, True, False), (160, True, True)],
)
def test_the_share_the_time_left_and_the_error_are_readable(
    monkeypatch: pytest.MonkeyPatch, columns: int, bar: bool, detailed: bool
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    with reporting("train") as show:
        show(0.42, "error 9.1%", 190.0, DETAILS)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    lines = [line.strip() for line in re.split(r"[\r\n]+", plain) if "42%" in line]
    assert lines
    for line in lines:
        assert line.startswith("train ")
        assert "42% · 3:10 left · error 9.1%" in line
        assert len(line) <= columns
        assert ("━" in line, DETAILS in line) == (bar, detailed)


def test_a_text_that_is_too_long_is_cut_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    with reporting("bake") as show:
        show(0.42, "pass 2: 1200 of 2930 vertices, 95 % of vertices 7.1 % (5 % asked)", 70.0)
    assert "42% · 1:10 left · pass 2: 1200 of 2930 ver" in terminal.getvalue()
    assert "asked" not in terminal.getvalue()


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00"), (59.6, "1:00"), (190.0, "3:10"), (7500.0, "2:05 h")])
def test_a_time_is_short(seconds: float, text: str) -> None:
    assert as_clock(seconds) == text


@pytest.mark.parametrize("at_once", [False, True])
def test_the_first_ctrl_c_interrupts_work_that_has_nothing_to_finish(at_once: bool) -> None:
    def press() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)  # signals are handled between two instructions

    with stopping() as stop:
        stop.at_once = at_once
        if at_once:
            with pytest.raises(KeyboardInterrupt):
                press()
        else:
            press()
            with pytest.raises(KeyboardInterrupt):
                press()
        assert stop()
