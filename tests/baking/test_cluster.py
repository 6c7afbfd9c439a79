"""Bakes by the workers of a dask.distributed scheduler in separate processes, some of which are killed."""

import gc
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import prt_bake.baking.cluster
from formats.asset import Asset
from formats.errors import ClusterError, QueryError
from prt_bake import bake
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF
from tests import ROOT
from tests.bakers.transports import Array, Incoherent, icosphere
from tests.baking.test_resume import Walker, same

pytestmark = pytest.mark.statistics

SMALL = {"rings": 2, "sectors": 16}
FIXED = {**SMALL, "samples": 64}


class Processes:
    """A scheduler and its workers, each in a separate process."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._number = folder, 0
        self._readers: list[threading.Thread] = []
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        self.address = self._wait_for(self.scheduler, "Scheduler at:").split()[-1]
        self.workers: list[subprocess.Popen[str]] = []

    def start_workers(self, count: int) -> None:
        new = [self._start("worker", self.address, "--no-nanny", "--nthreads", "1") for _ in range(count)]
        for worker in new:
            self._wait_for(worker, "Registered to:")
        self.workers += new

    def end(self) -> None:
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()
        for reader in self._readers:
            reader.join()

    def _start(self, kind: str, *arguments: str) -> subprocess.Popen[str]:
        self._number += 1
        paths = os.pathsep.join([str(ROOT), *(path for path in sys.path if path)])
        own = ["--no-dashboard", *arguments]
        if kind == "worker":
            own += ["--local-directory", str(self._folder / str(self._number))]
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *own]
        environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)

    def _wait_for(self, process: subprocess.Popen[str], words: str) -> str:
        assert process.stderr is not None
        for line in process.stderr:
            if words in line:
                # Further output is read and dropped, so that the process never blocks.
                self._readers.append(threading.Thread(target=read_to_end, args=[process]))
                self._readers[-1].start()
                return line
        raise AssertionError(f"a process ended without printing {words!r}")


def read_to_end(process: subprocess.Popen[str]) -> None:
    assert process.stderr is not None
    with process.stderr:
        process.stderr.read()


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    processes = Processes(tmp_path_factory.mktemp("cluster"))
    try:
        processes.start_workers(2)
        yield processes
    finally:
        processes.end()


def after_first_block(act: Callable[[], None]) -> Callable[..., None]:
    """A progress callback that acts once, after the first block, while others are in flight."""
    done: list[int] = []

    def progress(*_row: object) -> None:
        if not done:
            done.append(1)
            act()

    return progress


def assert_equal(one: Asset, other: Asset) -> None:
    for name in ("coefficients", "standard_error", "valid"):
        assert np.asarray(getattr(one, name)).tobytes() == np.asarray(getattr(other, name)).tobytes(), name


def test_a_cluster_with_a_killed_worker_bakes_the_same_bits(
    cluster: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 5 * 32)
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 5)
    mesh = icosphere(1)
    for kind in ({"error": 0.08, "lobes": 4}, {"samples": 32, "lobes": 4}):
        bake(Slow(), mesh, **SMALL, **kind, out=tmp_path / "here.h5")
        progress = after_first_block(cluster.workers[0].kill)
        bake(Slow(), mesh, **SMALL, **kind, out=tmp_path / "there.h5", scheduler=cluster.address, progress=progress)
        assert cluster.workers.pop(0).wait() != 0
        same(tmp_path / "there.h5", tmp_path / "here.h5")
        cluster.start_workers(1)
    # Networks are prepared again on the workers; walks use a process exclusively.
    network = NeuralBSSRDF(NetworkSettings(width=16, layers=3, features=8, skips=()), box_min=(-1.1,) * 3, box_side=2.2)
    arguments = {"rings": 2, "sectors": 16, "samples": 16}
    assert_equal(bake(network, mesh, **arguments, scheduler=cluster.address), bake(network, mesh, **arguments))
    there = bake(Walker(), mesh, **arguments, scheduler=cluster.address)
    assert_equal(there, bake(Walker(), mesh, **arguments))
    assert there.provenance["walks"]["unscattered"] == pytest.approx(0.25 / 32)


def test_a_bake_resumes_after_its_scheduler_is_lost(
    cluster: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 5)
    mesh, out = icosphere(1), tmp_path / "a.h5"
    # Errors of the work are raised as they are, not as faults of the cluster.
    with pytest.raises(QueryError, match="returned"):
        bake(Misshapen(), mesh, **FIXED, scheduler=cluster.address)
    with pytest.raises(ZeroDivisionError):
        bake(Faulty(), mesh, **FIXED, scheduler=cluster.address)
    import dask

    with (
        dask.config.set({"distributed.comm.timeouts.connect": "2s"}),
        pytest.raises(ClusterError, match="resume the bake"),
    ):
        bake(Slow(), mesh, **FIXED, out=out, scheduler=cluster.address, progress=after_first_block(cluster.end))
    assert 1 <= len(list((tmp_path / "a.h5.journal").glob("block-*"))) < 9
    bake(Slow(), mesh, **FIXED, out=out, resume=True)
    bake(Slow(), mesh, **FIXED, out=tmp_path / "whole.h5")
    same(out, tmp_path / "whole.h5")


class Slow(Incoherent):
    """Slow on the workers, so that they are killed during a block."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        if threading.current_thread() is not threading.main_thread():
            time.sleep(0.01)
        return super().evaluate(incident, positions, outgoing)


class Misshapen(Incoherent):
    """Returns values of another shape."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        return super().evaluate(incident, positions, outgoing)[:, :-1]


class Faulty(Incoherent):
    """Raises an error."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        return np.asarray(len(positions) / 0)


def test_missing_schedulers_and_missing_workers_raise(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import dask
    from distributed import Client  # loads the settings before one of them is changed

    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        for address in ("tcp://127.0.0.1:9", "nonsense://nowhere", ""):
            with pytest.raises(ClusterError, match="8786"):
                bake(Incoherent(), icosphere(0), **FIXED, scheduler=address)
            # An open client closes itself when it is collected, which may block the start of another one forever.
            assert {each.status for each in gc.get_objects() if type(each) is Client} <= {"closed"}
    with pytest.raises(QueryError, match="workers or a scheduler"):
        bake(Incoherent(), icosphere(0), **FIXED, scheduler="tcp://127.0.0.1:9", workers=2)
    monkeypatch.setattr(prt_bake.baking.cluster, "PATIENCE", 0.2)
    monkeypatch.setattr(prt_bake.baking.cluster, "POLL_INTERVAL", 0.1)
    none = Processes(tmp_path)
    try:
        with pytest.raises(ClusterError, match="no worker"):
            bake(Incoherent(), icosphere(0), **FIXED, scheduler=none.address)
    finally:
        none.end()


def test_a_closed_client_is_a_lost_scheduler() -> None:
    class Closed:
        def nthreads(self) -> dict[str, int]:
            raise RuntimeError("ConnectionPool is closed")

    with pytest.raises(ClusterError, match="resume the bake"):
        _workers = prt_bake.baking.cluster.Cluster(Closed(), "tcp://host:8786", False).count


def test_other_versions_on_a_worker_raise() -> None:
    packed = prt_bake.baking.cluster._packed({"some": "thing"})
    other = prt_bake.baking.cluster.Packed(packed.name, packed.content, packed.versions | {"numpy": "1.0"})
    assert prt_bake.baking.cluster._unpacked(packed, "w") is prt_bake.baking.cluster._unpacked(packed, "w")
    with pytest.raises(ClusterError, match=r"worker w: expected numpy 1.0, found"):
        prt_bake.baking.cluster._unpacked(other, "w")


def test_a_missing_extra_is_named_in_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ClusterError, match=r"pip install .dask\[distributed\]"):
        bake(Incoherent(), icosphere(0), **FIXED, scheduler="tcp://127.0.0.1:9")
