"""Progress of an adaptive bake: one share that increases over all passes."""

import itertools
import math
from typing import Any

import pytest

from prt_bake import bake
from prt_bake.baking.job.forecast import BakeStatus
from prt_bake.cli.shared.progress import NEARLY, bake_progress, reporting
from tests.bakers.transports import Incoherent, icosphere
from tests.baking.loose_pilot import loose_settings

Shown = list[tuple[float | None, str, float | None]]


def shown(monkeypatch: pytest.MonkeyPatch, **arguments: Any) -> tuple[Shown, list[BakeStatus]]:
    """The progress of a bake in small blocks, as shown and as reported."""
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 4 * 64)
    seen, statuses = Shown(), list[BakeStatus]()
    show = bake_progress(lambda share, words, left=None: seen.append((share, words, left)), arguments.get("error"))

    def progress(done: int, total: int, status: BakeStatus) -> None:
        statuses.append(status)
        show(done, total, status)

    bake(Incoherent(), icosphere(1), rings=4, sectors=16, progress=progress, **arguments)
    return seen, statuses


def test_the_share_never_decreases_between_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prt_bake.baking.adaptive.run.MANY", 0)
    monkeypatch.setattr("prt_bake.baking.adaptive.run.settings_for_error", loose_settings)
    seen, statuses = shown(monkeypatch, error=0.02)
    assert {status.stage for status in statuses} >= {"pass 1", "pilot after pass 1", "pass 2", "pass 3"}
    shares = [share for share, _words, _left in seen if share is not None]
    assert len(shares) == len(seen)
    assert all(before <= after for before, after in itertools.pairwise(shares))
    assert all(share <= NEARLY for share in shares)
    # The share is the elapsed over the total time, unless it would decrease.
    ratios = [min(row[0] / (row[0] + row.left), NEARLY) for row in statuses if row.left is not None]
    assert shares == pytest.approx(list(itertools.accumulate(ratios, max)))
    assert shares[0] < 0.9
    # The error of a coarse pass is unknown until its end; then the larger of both figures is shown.
    coarse = [(words, status) for (_share, words, _left), status in zip(seen, statuses, strict=True)]
    running = [(words, status) for words, status in coarse if status.stage == "pass 1"]
    assert {status.figures for _words, status in running[:-1]} == {None}
    assert running[0][0] == "pass 1: 4 of 42 vertices"
    for words, status in running[-1:] + [each for each in coarse if each[1].stage == "pass 2"]:
        assert status.figures is not None
        assert status.figures.worst >= status[2]
        name = "object" if status.figures.total == status.figures.worst else "95 % of vertices"
        assert words == f"{status.stage}: {name} {100.0 * status.figures.worst:.2g} % (2 % asked)"


def test_no_share_is_shown_without_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    stops = iter(range(10_000))
    seen, _standings = shown(monkeypatch, minutes=math.inf, stop=lambda: next(stops) > 40)
    assert {share for share, _words, _left in seen} == {None}


def test_the_time_left_is_extrapolated_from_the_first_share_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A minute of compiling and half of the work from an earlier run do not count for the speed."""
    clock = [100.0]
    monkeypatch.setattr("prt_bake.cli.shared.progress.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("prt_bake.cli.shared.progress.PLAIN_INTERVAL", 0.0)
    with reporting("render") as show:
        show(0.0, "begun")
        clock[0] += 60.0
        for after, share in ((0.0, 0.5), (2.0, 0.5625), (2.0, 0.625), (4.0, 0.75)):
            clock[0] += after
            show(share, "done")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "render  0% · begun",
        "render  50% · done",
        "render  56% · 0:14 left · done",
        "render  62% · 0:12 left · done",
        "render  75% · 0:08 left · done",
    ]


def test_lines_without_a_share_have_no_percentage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("prt_bake.cli.shared.progress.PLAIN_INTERVAL", 0.0)
    with reporting("bake") as show:
        show(None, "3 of 9 vertices")
        show(0.25, "4 of 9 vertices", 30.0)
        show(1.0, "")
    assert capsys.readouterr().err == "bake  3 of 9 vertices\nbake  25% · 0:30 left · 4 of 9 vertices\n"
