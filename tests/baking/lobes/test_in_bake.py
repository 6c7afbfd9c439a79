"""Lobes of a bake: found after its last pass, resumed, and left out where they cannot be."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
import prt_bake.baking.bake
from formats.asset import Asset
from formats.journal import journal_folder
from prt_bake.baking.adaptive.run import bake_to_error
from prt_bake.baking.job.forecast import BakeStatus
from prt_bake.baking.lobes import in_bake
from prt_bake.baking.report.summary import bake_report
from tests.baking.lobes.transports import MESH, Lobed, LowAlone, Smooth, along_normal, mirrored

ADAPTIVE: dict[str, Any] = {"rings": 4, "sectors": 8, "error": 0.05, "lobes": 4}
FIXED: dict[str, Any] = {"rings": 4, "sectors": 8, "samples": 32, "lobes": 4}


def same(first: Asset, second: Asset) -> bool:
    a, b = first.lobes, second.lobes
    assert a is not None
    assert b is not None
    names = ("axes", "sharpness", "powers")
    assert np.array_equal(np.asarray(first.coefficients), np.asarray(second.coefficients))
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


class StopInLobes:
    """Stops a bake once it has found lobes at some vertices."""

    stopped = False

    def progress(self, done: int, total: int, status: BakeStatus) -> None:
        self.stopped |= status.stage == "lobes" and done >= total // 2
        assert status.stage != "lobes" or status.figures is None  # so that vertices are counted, and no old error shown

    def stop(self) -> bool:
        return self.stopped


@pytest.mark.parametrize("arguments", [FIXED, ADAPTIVE], ids=["fixed", "adaptive"])
def test_a_bake_stopped_in_its_lobes_resumes(arguments: dict[str, Any], tmp_path: Path) -> None:
    whole = prt.bake(Lobed(), MESH, out=tmp_path / "whole.h5", **arguments)
    assert whole.provenance["lobes"]["lobes_in_a_view"] >= 1
    stop, path = StopInLobes(), tmp_path / "stopped.h5"
    stopped = prt.bake(Lobed(), MESH, out=path, progress=stop.progress, stop=stop.stop, **arguments)
    assert stopped.complete
    assert stopped.lobes is None
    with prt.read_asset(path) as kept:
        for entry in stopped.provenance["lobes"], kept.provenance["lobes"]:
            assert entry["lobes_in_a_view"] == 0
            assert entry["reason"] == "the bake ended before they were found"
    harmonics_alone = bake_report(stopped)["transport_error"]
    assert list(journal_folder(path).glob("lobes-*"))
    resumed = prt.bake(Lobed(), MESH, out=path, resume=True, **arguments)
    assert same(whole, resumed)
    assert resumed.provenance["lobes"] == whole.provenance["lobes"]
    assert harmonics_alone["with_lobes"] > bake_report(resumed)["transport_error"]["with_lobes"]
    assert not journal_folder(path).exists()


def test_lobes_are_found_in_all_bands_of_a_transport() -> None:
    """Also if coefficients come from a part of it."""
    whole, low = prt.bake(Lobed(), MESH, **FIXED), prt.bake(LowAlone(), MESH, **FIXED)
    added = prt.add_lobes(prt.bake(LowAlone(), MESH, **FIXED | {"lobes": 0}), LowAlone())
    assert np.allclose(low.coefficients[:, :, 1:], 0.0, atol=1e-6)
    assert whole.lobes is not None
    for found in (low.lobes, added.lobes):
        assert found is not None
        assert np.array_equal(found.powers, whole.lobes.powers)


def test_coefficients_are_those_without_lobes() -> None:
    with_lobes, without = (prt.bake(Lobed(), MESH, **FIXED | {"lobes": lobes}) for lobes in (4, 0))
    assert with_lobes.lobes is not None
    assert without.lobes is None
    assert np.array_equal(with_lobes.coefficients, without.coefficients)


@pytest.mark.parametrize(
    ("transport", "arguments", "reason"),
    [
        (Smooth(), {}, "gain nothing"),
        (Lobed(), {"lobes": 0}, "not requested"),
        (Lobed(), {"for_light": np.ones((9, 3))}, "one light"),
        (Lobed(), {"for_eye": [0.0, 0.0, 5.0]}, "one camera position"),
    ],
)
def test_the_reason_for_no_lobes_is_stated(transport: Any, arguments: dict[str, Any], reason: str) -> None:
    asset = prt.bake(transport, MESH, **{"rings": 4, "sectors": 8, "lobes": 4} | arguments)
    assert asset.lobes is None
    assert reason in asset.provenance["lobes"]["reason"]


def test_lobes_that_take_too_long_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_bake, "SHARE_OF_TIME", 0.0)
    asset = prt.bake(Lobed(), MESH, rings=4, sectors=8, minutes=0.02, lobes=4)
    assert asset.lobes is None
    assert "more than 0% of the time limit" in asset.provenance["lobes"]["reason"]


def test_a_bake_until_it_is_stopped_has_none() -> None:
    calls = iter(range(3))
    asset = prt.bake(
        Lobed(), MESH, minutes=math.inf, stop=lambda: next(calls, None) is None, lobes=4, rings=2, sectors=4
    )
    assert asset.lobes is None
    assert "`prtbake lobes` adds them" in asset.provenance["lobes"]["reason"]


def test_duplicates_have_the_same_lobes() -> None:
    faces = MESH.faces
    positions, normals = (np.concatenate([part, part[:5]]) for part in (MESH.positions, MESH.normals))
    doubled = prt.Mesh(positions, faces, normals)
    asset = prt.bake(Lobed(), doubled, leave_out=["duplicates"], **FIXED)
    assert asset.lobes is not None
    copies = len(MESH.positions) + np.arange(5)
    assert asset.valid[copies].all()
    assert np.array_equal(asset.lobes.powers[copies], asset.lobes.powers[:5])


def test_views_that_are_equal_have_one_node() -> None:
    class Equal(Lobed):
        def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> np.ndarray:
            return super().evaluate(incident, positions, np.broadcast_to([0.6, 0.0, 0.8], np.shape(outgoing)))

    asset = prt.bake(Equal(), MESH, rings=4, sectors=16, samples=128, lobes=4, leave_out=["views"])
    assert asset.coefficients.shape[1] == 1
    assert asset.lobes is not None
    assert asset.lobes.axes.shape[1] == 1


def test_the_report_adds_the_errors_of_both_parts() -> None:
    asset = prt.bake(Lobed(), MESH, **FIXED)
    entry, harmonics = asset.provenance["lobes"], asset.provenance["estimated_relative_rmse"]["total"]
    error = bake_report(asset)["transport_error"]
    within = harmonics * math.sqrt(1.0 - entry["beyond_harmonics"] ** 2)
    assert error["harmonics"] == pytest.approx(math.hypot(within, entry["beyond_harmonics"]))
    assert error["with_lobes"] == pytest.approx(math.hypot(within, entry["left_by_lobes"][-1]))
    assert "transport_error" not in bake_report(prt.bake(Lobed(), MESH, **FIXED | {"lobes": 0}))


def test_no_more_lobes_than_the_transport_has() -> None:
    one = prt.bake(Lobed(((along_normal, 12.0, 1.0),)), MESH, lobes=4, rings=4, sectors=16, samples=32)
    assert one.provenance["lobes"]["lobes_in_a_view"] == 1


def test_lobes_that_cannot_be_interpolated_are_not_kept() -> None:
    coarse = prt.bake(Lobed(((mirrored, 12.0, 1.0),)), MESH, lobes=4, rings=4, sectors=8, samples=32)
    assert coarse.lobes is None
    assert coarse.provenance["lobes"]["beyond_harmonics"] > 0.3


def test_a_time_limit_includes_the_lobes(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = []

    def ended(run: Any) -> Asset:
        limits.append(run.deadline - run.work.began)
        return bake_to_error(run)

    monkeypatch.setattr(prt_bake.baking.bake, "bake_to_error", ended)
    monkeypatch.setattr(in_bake, "SHARE_OF_TIME", 1.0)
    for lobes in (0, 4):
        prt.bake(Lobed(), MESH, rings=4, sectors=8, minutes=0.02, lobes=lobes)
    assert limits[0] == pytest.approx(1.2)
    assert limits[1] < 1.2 - 1e-6


def test_the_time_left_ends_with_the_lobes() -> None:
    left: dict[str, list[float]] = {}

    def progress(done: int, total: int, status: BakeStatus) -> None:
        left.setdefault(status.stage, []).append(status.left or 0.0)

    prt.bake(Lobed(), MESH, progress=progress, **FIXED)
    assert left["lobes"] == sorted(left["lobes"], reverse=True)
    assert left["lobes"][-1] == 0.0
    assert left[""][-1] > 0.0
