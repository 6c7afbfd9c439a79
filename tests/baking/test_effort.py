"""What a bake does without options, and how it says so."""

import itertools
from pathlib import Path
from typing import Any

import pytest

from bakers.plan import BakePlan
from formats.errors import InputWarning, QueryError
from prt_bake import bake
from prt_bake.baking.adaptive import run
from prt_bake.baking.bake import plan
from prt_bake.baking.job.effort import DEFAULT_ERROR, choose_effort
from tests.bakers.transports import Lobed, icosphere
from tests.baking.clock import Clock, Timed
from tests.cli.command_line import Run

GRID: dict[str, Any] = {"rings": 2, "sectors": 4}


class Walked:
    """Offers random walks alone."""

    def estimate_coefficients(self, *arguments: Any) -> Any:
        """Never called."""


SENTENCES: list[tuple[Any, str, tuple[Any, ...], str]] = [
    (Lobed(), "fibonacci", (None, None, None), "to 2 % error, the default"),
    (Lobed(), "fibonacci", (18, None, None), "with 18 directions per view bin"),
    (Lobed(), "fibonacci", (None, 0.005, None), "to 0.5 % error"),
    (Lobed(), "fibonacci", (18, 0.1, None), "to 10 % error; the 18 directions per view bin are ignored"),
    (Lobed(), "fibonacci", (None, None, 5.0), "for 5 minutes"),
    (Lobed(), "fibonacci", (None, None, 1.0), "for 1 minute"),
    (Lobed(), "fibonacci", (None, 0.01, 5.0), "to 1 % error, for at most 5 minutes"),
    (Lobed(), "fibonacci", (None, None, float("inf")), "until it is stopped"),
    (Lobed(), "sobol", (None, None, None), "with 64 directions per view bin, the default"),
    (Walked(), "fibonacci", (None, None, None), "with 64 paths per view bin, the default"),
    (Walked(), "fibonacci", (None, 0.1, None), "to 10 % error"),
]

FIXED = "directions per view bin", "paths per view bin", "the default"


@pytest.mark.parametrize(("transport", "directions", "given", "sentence"), SENTENCES)
def test_the_effort_is_said(transport: Any, directions: str, given: tuple[Any, ...], sentence: str) -> None:
    effort = choose_effort(transport, 2, directions, *given)
    assert effort.sentence == sentence
    walks = isinstance(transport, Walked)
    assert effort.adaptive == (not walks and sentence.startswith(("to", "for", "until")))


def test_a_bake_without_options_goes_to_the_default_error() -> None:
    default, requested = (bake(Lobed(), icosphere(1), **GRID, **more) for more in ({}, {"error": DEFAULT_ERROR}))
    assert default.provenance["settings"] == requested.provenance["settings"]
    assert (default.coefficients == requested.coefficients).all()
    fixed = bake(Lobed(), icosphere(1), **GRID, samples=20)
    assert fixed.provenance["settings"]["samples"] == 20
    assert fixed.provenance["settings"]["error"] is None


@pytest.mark.parametrize(("given", "used"), [(None, 98), (64, 64), (50, 50)])
def test_only_the_default_number_of_samples_depends_on_the_degree(given: int | None, used: int) -> None:
    asset = bake(Lobed(), icosphere(0), **GRID, degree=6, directions="sobol", samples=given)
    assert asset.provenance["settings"]["samples"] == used


def test_the_plan_of_a_time_is_for_that_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)

    def planned(**more: Any) -> BakePlan:
        return plan(Timed(Lobed(), clock, each=1e-5), icosphere(2), rings=4, sectors=16, **more)

    short, longer = planned(minutes=0.1), planned(minutes=5.0)
    assert short.seconds is not None
    assert short.seconds_between is not None
    assert 0.5 < short.seconds <= short.seconds_between[1] == 6.0
    assert short.error is not None
    assert longer.error is not None
    assert longer.error < 0.5 * short.error
    assert longer.evaluations > 2 * short.evaluations
    began = clock.now
    asset = bake(Timed(Lobed(), clock, each=1e-5), icosphere(2), rings=4, sectors=16, minutes=0.1)
    assert short.seconds_between[0] <= clock.now - began <= 6.0
    assert 0.3 < short.evaluations / asset.provenance["evaluations"] < 3.0
    # The time suffices for this error, so it is what decides.
    reached = planned(minutes=1000.0, error=0.2)
    assert reached.error == 0.2
    assert reached.seconds is not None
    assert reached.seconds < 60.0
    assert plan(Lobed(), icosphere(1), **GRID, minutes=float("inf")).seconds is None


def test_a_time_too_short_for_the_first_pass_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    transport = Timed(Lobed(), Clock(monkeypatch), each=4e-5)
    with pytest.warns(InputWarning, match=r"time is too short: the coarsest pass takes about \d\S* minutes") as warned:
        asset = bake(transport, icosphere(3), rings=4, sectors=16, minutes=0.1, lobes=0)
    assert len(warned) == 1
    assert not asset.complete


def test_a_time_too_short_for_one_vertex_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    transport = Timed(Lobed(), Clock(monkeypatch), each=4e-5)
    with pytest.raises(QueryError, match="ended before its first vertex was done, and nothing was written; give it"):
        bake(transport, icosphere(1), rings=4, sectors=16, minutes=0.001, lobes=0)


def test_a_bake_whose_time_ended_early_says_so(prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = itertools.count()
    monkeypatch.setattr(run, "vertices_at_once", lambda *_: 4)
    monkeypatch.setattr(run.Run, "stopped", property(lambda _: next(asked) > 2))
    grid = ["--rings", 2, "--sectors", 4, "--lobes", 0]
    outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", *grid, "--minutes", 5)
    assert outcome.code == 1
    assert "its time ended before every vertex was baked; the file is a valid partial asset" in outcome.err
