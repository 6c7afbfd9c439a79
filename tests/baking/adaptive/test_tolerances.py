"""What a pilot makes of its trials, and how much a bake spends on checks."""

from dataclasses import replace

import numpy as np
import pytest

from bakers.adaptive.calibration import Tally
from bakers.adaptive.records import Refined, Refinement
from formats.errors import QueryError
from prt_bake.baking.adaptive import tolerances as pilots
from prt_bake.baking.adaptive.pilot import MOST_CHECKS, Site, fewest_checks, first_refinement
from prt_bake.baking.adaptive.tolerances import (
    CHECK_COST,
    CHECK_NOISE,
    CHECKS_A_VERTEX,
    Aim,
    Pilot,
    aimed,
    coarse,
    refined_block,
)
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sphere
from tests.bakers.transports import Edged, Incoherent, Lobed, Shadowed, icosphere

MESH, ERROR = icosphere(1), 0.01


def site_of(transport: object, rings: int = 16, sectors: int = 64) -> Site:
    vertices = np.arange(len(MESH.positions))
    return Site(transport, MESH, vertices, views_of(MESH, rings, sectors)[1], sphere.view_bins(rings, sectors), 2, 0)


def scripted(errors: list[float], monkeypatch: pytest.MonkeyPatch, first: float = 1000.0) -> list[Refinement]:
    """Trials come to these errors, each cheaper than the one before, the first so many evaluations; what was tried is
    in the list.
    """
    tried: list[Refinement] = []

    def trial(_pilot: Pilot, how: Refinement, _error: float, _checks: float) -> tuple[Aim, Tally]:
        tried.append(how)
        tally = Tally(1)
        tally.variance[:], tally.done[:] = errors[len(tried) - 1], True
        per_vertex = first / len(tried)
        aim = replace(coarse(how, ERROR), error=errors[len(tried) - 1])
        return replace(aim, evaluations_per_vertex=per_vertex, evaluations_per_check=per_vertex), tally

    monkeypatch.setattr(pilots, "_trial", trial)
    return tried


@pytest.fixture(scope="module")
def refinement() -> Refinement:
    return first_refinement(site_of(Lobed()))[0]


@pytest.mark.parametrize(
    ("errors", "best", "trials"),
    [
        ([0.0085], 0, 1),
        ([0.004, 0.0085], 1, 2),
        # The same twice: nothing is cheaper.
        ([0.004, 0.004], 1, 2),
        # The last is far off, and an earlier one was good enough.
        ([0.0115, 0.012, 0.013, 0.011, 0.012, 0.014, 0.013, 0.03], 3, 8),
        ([0.02, 0.0099], 1, 2),
    ],
)
def test_the_best_of_the_trials_is_kept(
    errors: list[float], best: int, trials: int, refinement: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scripted(errors, monkeypatch)
    aim = pilots._calibrated(Pilot(site_of(Lobed())), refinement, ERROR, [])
    assert len(tried) == trials
    assert aim.error == errors[best]


def test_trials_that_are_all_far_off_are_out_of_reach(refinement: Refinement, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = scripted([0.05, 0.04, 0.03, 0.025, 0.022, 0.02, 0.02, 0.02] * 6, monkeypatch)
    with pytest.raises(QueryError, match="out of reach"):
        aimed(Pilot(site_of(Lobed())), refinement, ERROR)
    assert tried[-1].begin == len(refinement.lattice.sizes)


def test_trials_that_are_all_far_off_make_way_for_more_directions(
    refinement: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing of what they told is kept: it led nowhere."""
    tried = scripted([0.05] * pilots.MOST_PILOTS + [0.0085] * 2, monkeypatch)
    aim = pilots._calibrated(Pilot(site_of(Lobed())), refinement, ERROR, [])
    assert aim.error == 0.0085
    assert [how.begin - tried[0].begin for how in tried] == [0] * pilots.MOST_PILOTS + [2]
    assert tried[-1].pool_noise == tried[0].pool_noise
    assert tried[-1].light == tried[0].light


def test_errors_that_are_too_small_loosen_what_is_tolerated(
    refinement: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scripted([0.002, 0.003, 0.0085], monkeypatch)
    pilots._calibrated(Pilot(site_of(Lobed())), refinement, ERROR, [])
    assert tried[0].light < tried[1].light < tried[2].light


@pytest.mark.parametrize(("bin_takes", "trials"), [(11.0, 1), (30.0, 2)])
def test_learned_light_that_is_dear_for_being_too_exact_is_loosened(
    bin_takes: float, trials: int, refinement: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it is cheap as it is, no more is tried."""
    site, learned = site_of(Lobed()), replace(refinement, lattices="learned")
    tried = scripted([0.002, 0.0085, 0.0085], monkeypatch, first=bin_takes * site.bins)
    assert pilots._calibrated(Pilot(site), learned, ERROR, []).error == [0.002, 0.0085][trials - 1]
    assert [how.light > tried[0].light for how in tried] == [False, True][:trials]


@pytest.mark.parametrize("transport", [Lobed(), Incoherent()])
def test_checks_are_as_many_as_cost_little(transport: object) -> None:
    site = site_of(transport)
    aim = aimed(Pilot(site), first_refinement(site)[0], ERROR)
    share = aim.refinement.checks(site.vertices).mean()
    cost = aim.evaluations_per_check * share * site.bins / aim.evaluations_per_vertex
    least, most = fewest_checks(site) / site.many, MOST_CHECKS / site.many
    assert share == pytest.approx(np.clip(CHECK_COST * share / cost, least, most), rel=0.15)
    assert aim.refinement.checked <= 1.0001 * CHECK_NOISE * ERROR


def test_checks_that_are_dearer_than_all_the_rest_are_a_few_of_each_vertex() -> None:
    site = site_of(Shadowed())
    aim = aimed(Pilot(site), first_refinement(site)[0], ERROR)
    many = aim.refinement.checks(site.vertices).sum()
    assert CHECKS_A_VERTEX * len(site.vertices) <= many < 0.9 * fewest_checks(site)
    assert aim.evaluations_per_check * many > aim.evaluations_per_vertex * len(site.vertices)


@pytest.mark.parametrize(
    ("transport", "rings", "sectors", "lattices"),
    [
        # Alike from all views: what is foretold of a bin is right, and only that is held against it.
        (Edged(), 4, 32, "shared"),
        # A lobe that moves with the view: hardly anything is gained, and what is missed is missed at all bins.
        (Lobed(), 4, 32, "own"),
        # Of many bins few are evaluated.
        (Lobed(), 16, 64, "own"),
    ],
)
def test_bins_share_a_lattice_where_that_pays(transport: object, rings: int, sectors: int, lattices: str) -> None:
    site = site_of(transport, rings, sectors)
    assert aimed(Pilot(site), first_refinement(site)[0], ERROR).refinement.lattices == lattices


def test_a_pilot_of_few_bins_holds_as_many_against_others_as_is_cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a larger object, of which the same pilot is a smaller part, it holds more."""
    tried: list[tuple[Refinement, int]] = []
    trial = pilots._trial

    def counting(pilot: Pilot, how: Refinement, error: float, checks: float) -> tuple[Aim, Tally]:
        aim, tally = trial(pilot, how, error, checks)
        tried.append((how, tally.checked))
        return aim, tally

    monkeypatch.setattr(pilots, "_trial", counting)
    for mesh, many in ((MESH, 128), (icosphere(4), 640)):
        tried.clear()
        vertices = np.arange(len(mesh.positions))
        site = Site(Lobed(), mesh, vertices, views_of(mesh, 4, 8)[1], sphere.view_bins(4, 8), 2, 0)
        first, _spent = first_refinement(site)
        pilots._calibrated(Pilot(site), replace(first.for_views(0.1, 0.2), lattices="own"), 0.1, [])
        assert tried[-1][1] == pytest.approx(min(many, len(pilots.pilot_vertices(site)) * 32), rel=0.2)
        # What was said by fewer is not believed: the same is tried again.
        assert (len(tried) > 1 and tried[0][0].light == tried[1][0].light) == (many > 128)


@pytest.mark.parametrize(
    ("lattices", "least", "most"), [("own", 0.0, 0.01), ("shared", 0.3, 1.0), ("learned", 0.6, 1.0)]
)
def test_what_bins_have_in_common_is_the_lattice_that_they_share(lattices: str, least: float, most: float) -> None:
    site = site_of(Edged(), 4, 16)
    how = replace(coarse(first_refinement(site)[0], 0.05).refinement, lattices=lattices)
    refined: Refined = refined_block(site, how, site.vertices[:4])[0]
    assert ((refined.together >= least) & (refined.together <= most)).all()
