"""Killed bakes resume with bitwise equal results, changed settings are named, a full disk loses nothing."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from formats.errors import StorageError
from formats.journal import Journal
from prt_bake import bake, read_asset
from tests.bakers.transports import Incoherent, icosphere
from tests.baking.loose_pilot import loose_settings

BLOCKS = {"rings": 4, "sectors": 16, "error": 0.05}

KILLED = """
import sys
sys.path[:0] = {path!r}
import os, signal
from prt_bake import bake
from formats.journal import Journal
from prt_bake.baking.adaptive import adaptive_job, run
from tests.bakers.transports import Incoherent, icosphere
from tests.baking.loose_pilot import loose_settings
write, remaining = Journal.write, [{blocks}]
def write_or_die(self, name, arrays):
    write(self, name, arrays)
    remaining[0] -= not name.startswith("settings")
    if remaining[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.write = write_or_die
adaptive_job.BINS_AT_ONCE = 5 * 64
run.settings_for_error = loose_settings
bake(Incoherent(), icosphere(1), rings=4, sectors=16, error=0.05, out={out!r})
"""


def contents(path: Path) -> dict[str, np.ndarray]:
    found = {}
    with h5py.File(path) as file:
        for group in ("mesh", "basis", "bins", "transfer"):
            file[group].visititems(
                lambda name, item, group=group: (
                    found.update({f"{group}/{name}": item[()]}) if isinstance(item, h5py.Dataset) else None
                )
            )
    return found


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """The contents of an uninterrupted bake of two passes."""
    out = tmp_path_factory.mktemp("uninterrupted") / "asset.h5"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 64)
        patched.setattr("prt_bake.baking.adaptive.run.settings_for_error", loose_settings)
        with bake(Incoherent(), icosphere(1), **BLOCKS, out=out, workers=2) as asset:
            assert asset.provenance["refinement"]["passes"] == 2
    return contents(out)


@pytest.mark.statistics
@pytest.mark.parametrize("blocks", [1, 4, 9, 10, 13, 19, 20])
def test_a_killed_and_resumed_bake_equals_an_uninterrupted_one(
    tmp_path: Path, blocks: int, uninterrupted: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "killed.h5"
    script = KILLED.format(path=[p for p in sys.path if p], blocks=blocks, out=str(out))
    killed = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    journal = tmp_path / "killed.h5.journal"
    assert sum(not path.name.startswith("settings") for path in journal.glob("*.npz")) == blocks
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 64)
    monkeypatch.setattr("prt_bake.baking.adaptive.run.settings_for_error", loose_settings)
    evaluated: list[int] = []

    class Counting(Incoherent):
        def evaluate(self, incident: np.ndarray, positions: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
            evaluated.append(incident.shape[0] * incident.shape[1])
            return super().evaluate(incident, positions, outgoing)

    Counting.__name__ = "Incoherent"
    resumed = bake(Counting(), icosphere(1), **BLOCKS, out=out, resume=True)
    assert sum(evaluated) < resumed.provenance["evaluations"]
    found = contents(out)
    assert found.keys() == uninterrupted.keys()
    for name in found:
        np.testing.assert_array_equal(found[name], uninterrupted[name], err_msg=name)
    assert not journal.exists()


def test_a_bake_with_changed_settings_is_not_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "asset.h5"
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 64)
    calls = iter([False] * 2 + [True] * 100)
    part = bake(Incoherent(), icosphere(1), **BLOCKS, out=out, stop=lambda: next(calls))
    assert not part.complete
    assert part.provenance["vertices_baked"] == 10
    for changed, sentence in (({"error": 0.04}, "error was 0.05 and is 0.04"), ({"seed": 5}, "seed was 0 and is 5")):
        with pytest.raises(StorageError, match=sentence):
            bake(Incoherent(), icosphere(1), **{**BLOCKS, **changed}, out=out, resume=True)
    with pytest.raises(StorageError, match="mesh was"):
        bake(Incoherent(), icosphere(0), **BLOCKS, out=out, resume=True)
    assert bake(Incoherent(), icosphere(1), **BLOCKS, out=out, resume=True).complete


def test_a_full_disk_is_reported_and_loses_no_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "asset.h5"
    bake(Incoherent(), icosphere(1), rings=4, sectors=16, error=0.2, out=out)
    before = out.read_bytes()
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 64)
    save, left = np.savez, [4]

    def full(file: object, **arrays: object) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(file, **arrays)  # type: ignore[arg-type]

    monkeypatch.setattr("formats.journal.np.savez", full)
    with pytest.raises(StorageError, match="disk is full"):
        bake(Incoherent(), icosphere(1), **BLOCKS, out=out)
    assert out.read_bytes() == before
    assert len(list((tmp_path / "asset.h5.journal").glob("*.npz"))) == 4
    monkeypatch.setattr("formats.journal.np.savez", save)
    assert bake(Incoherent(), icosphere(1), **BLOCKS, out=out, resume=True).complete
    assert read_asset(out).provenance["settings"]["error"] == 0.05


def test_damaged_blocks_are_treated_as_missing(tmp_path: Path) -> None:
    with Journal(tmp_path / "a.h5", {"seed": 1}, resume=False) as journal:
        journal.write("00-0", {"numbers": np.arange(5.0)})
    with Journal(tmp_path / "a.h5", {"seed": 1}, resume=True) as kept:
        assert kept.resumed
        np.testing.assert_array_equal(kept.read("00-0")["numbers"], np.arange(5.0))  # type: ignore[index]
        path = kept.folder / "00-0.npz"
        path.write_bytes(path.read_bytes()[:100])
        assert kept.read("00-0") is None
        assert kept.read("00-9") is None
    (journal.folder / "identity.json").write_text("{")
    with pytest.raises(StorageError, match="seed was None"):
        Journal(tmp_path / "a.h5", {"seed": 1}, resume=True)
    with Journal(tmp_path / "a.h5", {"seed": 2}, resume=False) as new:
        assert not new.names("")
    assert not journal.folder.exists()
