"""Bakes that are killed at any moment resume to the same bits."""

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from bakers.path_traced import WalkStatistics
from formats.errors import StorageError
from formats.journal import Journal
from prt_bake import bake, read_asset
from prt_bake.baking.job.forecast import BakeStatus
from tests import ROOT
from tests.bakers.transports import Incoherent, Lobed, icosphere
from tests.baking.clock import Clock, Timed
from tests.baking.loose_pilot import loose_settings

pytestmark = pytest.mark.statistics

GROUPS = "mesh", "basis", "bins", "transfer", "lobes"
SMALL = {"rings": 2, "sectors": 16}
FIXED = {**SMALL, "samples": 64}


def contents(path: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    with h5py.File(path) as file:
        assert file.attrs["complete"] == 1
        for group in GROUPS:
            for name, item in file.get(group, {}).items():
                found[f"{group}/{name}"] = item[()]
    return found


def same(one: Path, other: Path) -> None:
    found, expected = contents(one), contents(other)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert found[name].tobytes() == values.tobytes(), name


@pytest.mark.parametrize(("kind", "seed"), [("error", 1), ("samples", 2), ("error by samples", 3)])
def test_a_bake_killed_at_any_moment_and_resumed_equals_one_run(tmp_path: Path, kind: str, seed: int) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *(path for path in sys.path if path)])}
    command = [sys.executable, "-m", "tests.baking.killing", str(tmp_path), kind, str(seed)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout.split()[0]) >= 2
    same(tmp_path / "killed.h5", tmp_path / "whole.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed.h5", "whole.h5"]


class Walker:
    """Random coefficients, with walk statistics."""

    def estimate_coefficients(
        self, positions: np.ndarray, outgoing: np.ndarray, degree: int, paths: int, seed: int
    ) -> object:
        return self.estimate_block(positions[:1], outgoing[None], degree, paths, [seed])

    def estimate_block(
        self, positions: np.ndarray, outgoing: np.ndarray, degree: int, paths: int, seeds: list[int]
    ) -> object:
        shape = (*outgoing.shape[:2], (degree + 1) ** 2, 3)
        drawn = np.stack([np.random.default_rng(seed).normal(1.0, 0.1, shape[1:]) for seed in seeds])

        class Estimate:
            mean, standard_error = drawn, np.full(shape, 0.1 / paths**0.5)
            statistics = WalkStatistics(bins=shape[0] * shape[1], unreliable=shape[0], unscattered=0.25 * shape[0])

        return Estimate()


@pytest.mark.parametrize("transport", [Incoherent(), Walker()])
def test_a_stopped_bake_resumes_with_other_blocks(
    tmp_path: Path, transport: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, whole = tmp_path / "stopped.h5", tmp_path / "whole.h5"
    bake(transport, icosphere(0), **FIXED, out=whole).close()
    for blocks, size in ((2, 2), (3, 3)):
        monkeypatch.setattr("bakers.baker.block_size", lambda task, size=size: size)
        calls = iter([False] * blocks + [True] * 100)
        part = bake(transport, icosphere(0), **FIXED, out=out, stop=lambda calls=calls: next(calls), resume=True)
        part.close()
        assert not part.complete
        assert (tmp_path / "stopped.h5.journal").is_dir()
    baked: list[int] = []
    monkeypatch.setattr("prt_bake.baking.fixed_samples.bake_block", _counting(baked))
    resumed = bake(transport, icosphere(0), **FIXED, out=out, workers=2, resume=True)
    assert sum(baked) == 12 - 2 * 2 - 3
    one = read_asset(whole).provenance
    assert resumed.provenance["evaluations"] == one["evaluations"]
    assert resumed.provenance.get("walks") == one.get("walks")
    resumed.close()
    same(out, whole)


def _counting(baked: list[int]) -> object:
    from bakers.baker import bake_block

    def counted(task: object, first: int, last: int) -> object:
        baked.append(last - first)
        return bake_block(task, first, last)  # type: ignore[arg-type]

    return counted


class Killed(BaseException):
    """Ends the process."""


@pytest.mark.parametrize("removed", [1, 4, 7])
def test_a_kill_while_finished_blocks_are_removed(
    tmp_path: Path, removed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two passes, the second of which needs the blocks of the first: a mixture of both cannot be resumed.
    monkeypatch.setattr("prt_bake.baking.adaptive.run.settings_for_error", loose_settings)
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 32)
    out, whole, left = tmp_path / "a.h5", tmp_path / "whole.h5", [removed]
    unlink, glob = Path.unlink, Path.glob
    arguments = {**SMALL, "error": 0.03}
    with bake(Incoherent(), icosphere(1), **arguments, out=whole) as asset:
        assert asset.provenance["refinement"]["passes"] == 2

    def of_last(path: Path) -> bool:
        # The file system may list the last pass first.
        return "02" not in path.name

    def some(path: Path, missing_ok: bool = False) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise Killed
        unlink(path, missing_ok=missing_ok)

    def killed(journal: Journal) -> None:
        with monkeypatch.context() as during:
            during.setattr(Path, "glob", lambda path, pattern: sorted(glob(path, pattern), key=of_last))
            during.setattr(Path, "unlink", some)
            journal._empty()

    with monkeypatch.context() as during:
        during.setattr(Journal, "remove", killed)
        with pytest.raises(Killed):
            bake(Incoherent(), icosphere(1), **arguments, out=out)
    bake(Incoherent(), icosphere(1), **arguments, out=out, resume=True).close()
    same(out, whole)


def test_a_bake_with_changed_arguments_does_not_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 2)
    calls = iter([False] + [True] * 100)
    bake(Incoherent(), icosphere(0), **FIXED, out=tmp_path / "a.h5", stop=lambda: next(calls)).close()
    for changed, sentence in (
        ({"samples": 32}, "samples was 64 and is 32"),
        ({"directions": "sobol"}, "directions was 'fibonacci' and is 'sobol'"),
        ({"error": 0.5, "directions": "uniform"}, "error was None and is 0.5"),
    ):
        with pytest.raises(StorageError, match=sentence):
            bake(Incoherent(), icosphere(0), **{**FIXED, **changed}, out=tmp_path / "a.h5", resume=True)


def test_a_bake_for_a_time_resumes_with_another_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 32)
    out, whole, arguments = tmp_path / "a.h5", tmp_path / "whole.h5", {**SMALL, "error": 0.5}
    bake(Incoherent(), icosphere(1), **arguments, minutes=9.0, out=whole).close()
    calls = iter([False] * 4 + [True] * 1000)
    bake(Incoherent(), icosphere(1), **arguments, minutes=5.0, out=out, stop=lambda: next(calls)).close()
    assert list((tmp_path / "a.h5.journal").glob("00-*.npz"))
    bake(Incoherent(), icosphere(1), **arguments, minutes=3.0, out=out, resume=True).close()
    same(out, whole)
    calls = iter([False] * 4 + [True] * 1000)
    bake(Incoherent(), icosphere(1), **arguments, minutes=5.0, out=out, stop=lambda: next(calls)).close()
    with pytest.raises(StorageError, match="minutes was 'any' and is None"):
        bake(Incoherent(), icosphere(1), **arguments, out=out, resume=True)


def killed_in(stage: str) -> Callable[[int, int, BakeStatus], None]:
    """A progress callback that ends the process in a stage."""

    def progress(done: int, total: int, status: BakeStatus) -> None:
        if status.stage == stage:
            raise Killed

    return progress


@pytest.mark.parametrize(("minutes", "finer"), [(1e-4, False), (0.5, True)])
def test_a_killed_bake_for_a_time_goes_on_from_its_last_complete_pass(
    tmp_path: Path, minutes: float, finer: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, each = Clock(monkeypatch), 4e-5
    transport, out = Timed(Lobed(), clock, each), tmp_path / "a.h5"
    arguments: dict[str, Any] = {"rings": 4, "sectors": 16, "out": out}
    with pytest.raises(Killed):
        bake(transport, icosphere(0), **arguments, minutes=1.0, progress=killed_in("pass 3"))
    with read_asset(out) as before:
        passes, rows = before.provenance["refinement"]["passes"], before.error_vs_time
    began = clock.now
    with bake(transport, icosphere(0), **arguments, minutes=minutes, resume=True) as asset:
        assert asset.complete
        assert asset.valid.all()
        assert passes == 2
        assert (asset.provenance["refinement"]["passes"] > passes) == finer
        assert (asset.error_vs_time[-1, 2] < rows[-1, 2]) == finer
        np.testing.assert_array_equal(asset.error_vs_time[: len(rows)], rows)
        if finer:
            spent = clock.now - began
            assert asset.error_vs_time[-1, 0] == pytest.approx(rows[-1, 0] + spent, rel=0.01)
            assert asset.provenance["evaluations"] == pytest.approx(rows[-1, 1] + spent / each, rel=0.01)


def test_a_bake_for_a_time_begins_anew_without_its_asset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    transport, out = Timed(Lobed(), Clock(monkeypatch), each=4e-5), tmp_path / "a.h5"
    arguments: dict[str, Any] = {"rings": 4, "sectors": 16, "out": out}
    with pytest.raises(Killed):
        bake(transport, icosphere(0), **arguments, minutes=1.0, progress=killed_in("pass 3"))
    with read_asset(out) as before:
        minutes = 1.05 * before.error_vs_time[0, 0] / 60.0
    out.unlink()
    with bake(transport, icosphere(0), **arguments, minutes=minutes, resume=True) as asset:
        assert asset.complete
        assert asset.valid.all()


def test_a_damaged_result_of_a_bake_for_a_time_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    transport, out = Timed(Lobed(), Clock(monkeypatch), each=4e-5), tmp_path / "a.h5"
    arguments: dict[str, Any] = {"rings": 4, "sectors": 16, "out": out, "minutes": 1.0}
    with pytest.raises(Killed):
        bake(transport, icosphere(0), **arguments, progress=killed_in("pass 3"))
    before = out.read_bytes()
    damaged = tmp_path / "a.h5.journal" / "done-01.npz"
    damaged.write_bytes(damaged.read_bytes()[:100])
    with pytest.raises(StorageError, match="checkpoint done-01: expected the result of a complete pass"):
        bake(transport, icosphere(0), **arguments, resume=True)
    assert out.read_bytes() == before


@pytest.mark.parametrize("block", [0, 10])
def test_a_damaged_block_of_a_complete_pass_is_refused(
    tmp_path: Path, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prt_bake.baking.adaptive.run.settings_for_error", loose_settings)
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 32)
    out, arguments = tmp_path / "a.h5", {**SMALL, "error": 0.03}
    with pytest.raises(Killed):
        bake(Incoherent(), icosphere(1), **arguments, out=out, progress=killed_in("pass 2"))
    damaged = tmp_path / "a.h5.journal" / f"01-{block}.npz"
    damaged.write_bytes(damaged.read_bytes()[:100])
    with pytest.raises(StorageError, match=rf"checkpoint 01-{block}: expected a finished block .* bake again"):
        bake(Incoherent(), icosphere(1), **arguments, out=out, resume=True)


def test_a_full_disk_loses_no_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, whole = tmp_path / "a.h5", tmp_path / "whole.h5"
    bake(Incoherent(), icosphere(0), **FIXED, out=whole).close()
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 2)
    save, left = np.savez, [3]

    def full(file: object, **arrays: object) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(file, **arrays)  # type: ignore[arg-type]

    with monkeypatch.context() as during:
        during.setattr("formats.journal.np.savez", full)
        with pytest.raises(StorageError, match="disk is full"):
            bake(Incoherent(), icosphere(0), **FIXED, out=out)
    assert len(list((tmp_path / "a.h5.journal").glob("*.npz"))) == 3
    assert not out.exists()
    bake(Incoherent(), icosphere(0), **FIXED, out=out, resume=True).close()
    same(out, whole)


def test_a_disk_too_full_for_the_asset_loses_no_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "a.h5"

    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as during:
        during.setattr("formats.asset.asset_file.AssetFile.close", full)
        with pytest.raises(StorageError, match="disk is full"):
            bake(Incoherent(), icosphere(0), **FIXED, out=out)
    baked: list[int] = []
    monkeypatch.setattr("prt_bake.baking.fixed_samples.bake_block", _counting(baked))
    assert bake(Incoherent(), icosphere(0), **FIXED, out=out, resume=True).complete
    assert baked == []


@pytest.mark.parametrize("arguments", [{"error": 0.2}, {"samples": 32}])
def test_resuming_with_another_transport_of_the_same_class_raises(
    tmp_path: Path, arguments: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bakers.baker.block_size", lambda task: 8)
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 8 * 32)
    out, calls = tmp_path / "mixed.h5", iter([False] * 2 + [True] * 100)
    stopped = bake(Lobed(8.0), icosphere(1), **SMALL, **arguments, out=out, stop=lambda: next(calls))  # type: ignore[arg-type]
    assert not stopped.complete
    stopped.close()
    with pytest.raises(StorageError, match="transport was"):
        bake(Lobed(30.0), icosphere(1), **SMALL, **arguments, out=out, resume=True)  # type: ignore[arg-type]
    assert bake(Lobed(8.0), icosphere(1), **SMALL, **arguments, out=out, resume=True).complete  # type: ignore[arg-type]


def test_a_stopped_finer_pass_keeps_its_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A complete coarse asset exists by then, but its error is larger than requested."""
    out, whole, arguments = tmp_path / "a.h5", tmp_path / "whole.h5", {"rings": 4, "sectors": 16, "error": 0.05}
    bake(Incoherent(), icosphere(1), **arguments, out=whole).close()
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 64)
    monkeypatch.setattr("prt_bake.baking.adaptive.run.MANY", 1)

    def kept(stage: str) -> int:
        return len(list((tmp_path / "a.h5.journal").glob(f"{stage}*.npz")))

    def stopped(stop: Callable[[], bool]) -> float:
        with bake(Incoherent(), icosphere(1), **arguments, out=out, stop=stop, resume=True) as coarse:
            assert coarse.complete
            assert coarse.valid.all()
            return float(coarse.provenance["estimated_relative_rmse"]["total"])

    assert stopped(lambda: kept("done-00") > 0) > 0.05
    assert kept("00-") > 0
    assert kept("01-") == 0
    assert stopped(lambda: kept("01-") >= 4) > 0.05
    assert 4 <= kept("01-") < 9
    with bake(Incoherent(), icosphere(1), **arguments, out=out, resume=True) as resumed:
        assert resumed.provenance["estimated_relative_rmse"]["total"] <= 0.05
    same(out, whole)
    assert not (tmp_path / "a.h5.journal").exists()
