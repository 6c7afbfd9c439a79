"""How far a bake says that it is: one way to its target, whatever passes lead there."""

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


def shown(monkeypatch: pytest.MonkeyPatch, **asked: Any) -> tuple[Shown, list[BakeStatus]]:
    """What a bake in small blocks shows, and what it was told."""
    monkeypatch.setattr("prt_bake.baking.adaptive.pilot.BINS_AT_ONCE", 4 * 64)
    seen, statuses = Shown(), list[BakeStatus]()
    told = bake_progress(lambda share, words, left=None: seen.append((share, words, left)))

    def progress(done: int, total: int, status: BakeStatus) -> None:
        statuses.append(status)
        told(done, total, status)

    bake(Incoherent(), icosphere(1), rings=4, sectors=16, progress=progress, **asked)
    return seen, statuses


def test_the_share_never_goes_back_from_pass_to_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prt_bake.baking.adaptive.run.MANY", 0)
    monkeypatch.setattr("prt_bake.baking.adaptive.run.settings_for_error", loose_settings)
    seen, statuses = shown(monkeypatch, error=0.02)
    assert {status.stage for status in statuses} >= {"pass 1", "pilot after pass 1", "pass 2", "pass 3"}
    shares = [share for share, _words, _left in seen if share is not None]
    assert len(shares) == len(seen)
    assert all(before <= after for before, after in itertools.pairwise(shares))
    assert all(share <= NEARLY for share in shares)
    # It is no more than the time done over that and what is left, but where it would have to go back.
    ratios = [min(row[0] / (row[0] + row.left), NEARLY) for row in statuses if row.left is not None]
    assert shares == pytest.approx(list(itertools.accumulate(ratios, max)))
    assert shares[0] < 0.9


def test_where_there_is_no_end_no_share_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    stops = iter(range(10_000))
    seen, _standings = shown(monkeypatch, minutes=math.inf, stop=lambda: next(stops) > 40)
    assert {share for share, _words, _left in seen} == {None}


def test_what_is_left_is_foretold_by_what_was_done_since_the_first_share(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A minute of compiling, and half of the work done by an earlier run: neither says how fast it goes on."""
    clock = [100.0]
    monkeypatch.setattr("prt_bake.cli.shared.progress.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("prt_bake.cli.shared.progress.PLAIN_INTERVAL", 0.0)
    with reporting("render") as show:
        show(0.0, "begun")
        clock[0] += 60.0
        for after, share in ((0.0, 0.5), (2.0, 0.5625), (2.0, 0.625), (4.0, 0.75)):
            clock[0] += after
            show(share, "done")
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "render: 0% begun",
        "render: 50% done",
        "render: 56% done, 14 s left",
        "render: 62% done, 12 s left",
        "render: 75% done, 8 s left",
    ]


def test_lines_without_a_share_have_no_percentage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("prt_bake.cli.shared.progress.PLAIN_INTERVAL", 0.0)
    with reporting("bake") as show:
        show(None, "3 of 9 vertices")
        show(0.25, "4 of 9 vertices", 30.0)
        show(1.0, "")
    assert capsys.readouterr().err == "bake: 3 of 9 vertices\nbake: 25% 4 of 9 vertices, 30 s left\n"
