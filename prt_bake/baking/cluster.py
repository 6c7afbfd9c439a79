"""Bakes on several machines: the workers of a `dask.distributed` scheduler bake the blocks of vertices.

The transport and other arguments that blocks share are pickled and sent to the scheduler once, and from there to each
worker. If a worker dies, its blocks are baked again elsewhere. Only the process of the caller writes files.
`distributed` is imported only if a scheduler is given.
"""

import ctypes
import hashlib
import pickle
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from threading import Lock
from typing import Any, TypeVar

from bakers.in_order import in_order
from formats.errors import ClusterError, PrtbakeError

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE = 60.0
"""Seconds without any worker after which the bake fails."""
POLL_INTERVAL = 2.0
"""Seconds between two queries of the number of workers."""
AHEAD = 2
"""Blocks in flight for each thread of the cluster, so that no thread waits."""
MOST_AHEAD = 1024
SHARED_OBJECTS = 8
"""Number of shared objects that the scheduler and each worker keep."""
PACKAGES = "prt-bake", "numpy", "torch", "numba"
"""Client and workers must have the same versions of these, so that they compute the same numbers."""

LARGEST_KEPT = 32 << 20
"""Bytes of the largest arrays whose memory a worker keeps for reuse."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


@dataclass(frozen=True)
class Packed:
    """A pickled object that blocks share, with the package versions of the client."""

    name: str
    content: bytes
    versions: dict[str, str]


class Cluster:
    """The workers of a scheduler (`bakers.workers.Workers`)."""

    def __init__(self, client: Any, address: str, exclusive: bool) -> None:
        """`exclusive`: each process bakes one block at a time, on all of its threads."""
        self._client, self._address, self._exclusive = client, address, exclusive
        self._lock = Lock()
        self._sent: OrderedDict[int, tuple[Any, Any]] = OrderedDict()
        self._threads, self._polled, self._last_seen = 0, 0.0, time.monotonic()

    @property
    def count(self) -> int:
        """How many blocks are done at the same time."""
        with self._lock:
            now = time.monotonic()
            if now - self._polled > POLL_INTERVAL:
                self._polled, self._threads = now, self._threads_now()
            if self._threads:
                self._last_seen = now
            elif now - self._last_seen > PATIENCE:
                raise ClusterError(
                    f"{self._address}: the scheduler has had no worker for {PATIENCE:.0f} s; start workers "
                    f"(dask worker {self._address}) and resume the bake: finished blocks are kept"
                )
            return max(1, self._threads)

    def _threads_now(self) -> int:
        # A client that has lost its scheduler raises RuntimeError.
        with _cluster_faults(self._address, OSError, RuntimeError):
            threads = self._client.nthreads().values()
        return len(threads) if self._exclusive else sum(threads)

    def in_order(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """Yields work(item) in order, with a few items per worker in flight; more when workers join."""
        return in_order(work, items, MOST_AHEAD, lambda: min(AHEAD * self.count, MOST_AHEAD - 1))

    def do(self, work: Callable[..., Result], shared: tuple[Any, ...], *own: Any) -> Result:
        """work(*shared, *own), by one of the workers. Raises what the work raises, and ClusterError for faults of the
        cluster.
        """
        from distributed import TimeoutError as NotYet

        packed = [self._future_of(each) for each in shared]
        with _cluster_faults(self._address):
            task = self._client.submit(_run, work, self._exclusive, own, *packed, pure=False)
            while True:
                try:
                    result: Result = task.result(timeout=POLL_INTERVAL)
                    return result
                # `distributed` raises UnboundLocalError if a query is cancelled while it times out.
                except (NotYet, UnboundLocalError):
                    if task.status == "error":
                        raise
                    _any = self.count

    def _future_of(self, shared: Any) -> Any:
        """The future of a shared object, which is sent at its first use."""
        with self._lock:
            if id(shared) not in self._sent:
                packed = _packed(shared)
                with _cluster_faults(self._address):
                    # As a task: scattered data would be lost with the workers that hold it.
                    future = self._client.submit(Packed, packed.name, packed.content, packed.versions, pure=False)
                # Keeps the object alive, so that its id stays unique.
                self._sent[id(shared)] = shared, future
            self._sent.move_to_end(id(shared))
            while len(self._sent) > SHARED_OBJECTS:
                self._sent.popitem(last=False)
            return self._sent[id(shared)][1]


@contextmanager
def open_cluster(address: str, exclusive: bool) -> Iterator[Cluster]:
    """The workers of the scheduler at `address`.

    Raises ClusterError if no scheduler is there, if it has no worker for a minute, or if `dask.distributed` is missing.
    """
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise ClusterError(
            "scheduler: dask.distributed is not installed; pip install 'dask[distributed]', here and on the workers"
        ) from None

    quiet = {"distributed.admin.large-graph-warning-threshold": sys.maxsize}
    with dask.config.set(quiet), _connected(Client, address) as client:
        pool = Cluster(client, address, exclusive)
        while not client.nthreads():
            _polled = pool.count
            time.sleep(0.1)
        yield pool


def _connected(client: Any, address: str) -> Any:
    """A `client` of the scheduler at `address`; raises ClusterError if none answers.

    A client whose constructor failed would close itself when it is garbage collected, under a lock that the next client
    takes as it starts: a deadlock. So the object exists before its constructor runs, and is closed immediately.
    """
    new = client.__new__(client)
    try:
        new.__init__(address, set_as_default=False)
    except (OSError, ValueError, TypeError) as cause:
        new.close()
        raise ClusterError(
            f"scheduler {address}: no scheduler of dask.distributed answers there ({cause}); expected an address "
            f"such as tcp://host:8786, as `dask scheduler` prints it"
        ) from cause
    return new


@contextmanager
def _cluster_faults(address: str, *lost: type[Exception]) -> Iterator[None]:
    """Turns faults of the cluster into ClusterError; `lost` are further exceptions that mean a lost scheduler."""
    from concurrent.futures import CancelledError as Cancelled

    from distributed import CancelledError, KilledWorker
    from distributed.client import ClosedClientError
    from distributed.comm.core import CommClosedError

    vanished: tuple[Any, ...] = (CancelledError, Cancelled, CommClosedError, ClosedClientError, *lost)
    try:
        yield
    except PrtbakeError:
        raise
    except KilledWorker as cause:
        raise ClusterError(
            f"{address}: {cause.allowed_failures + 1} workers died one after the other with the same block; check "
            f"that they have enough memory, and resume the bake: finished blocks are kept"
        ) from cause
    except vanished as cause:
        raise ClusterError(
            f"{address}: the connection to the scheduler is lost; restart it and its workers, and "
            f"resume the bake: finished blocks are kept"
        ) from cause
    except ImportError as cause:
        raise ClusterError(
            f"{address}: a worker cannot import what the bake needs ({cause}); install there what is installed here"
        ) from cause


def _packed(shared: Any) -> Packed:
    """Pickled with cloudpickle, which also pickles local functions and definitions of the main program."""
    import cloudpickle

    content = cloudpickle.dumps(shared, protocol=pickle.HIGHEST_PROTOCOL)
    return Packed(hashlib.sha256(content).hexdigest(), content, _versions())


@cache
def _versions() -> dict[str, str]:
    return {package: version(package) for package in PACKAGES}


_unpickled: OrderedDict[str, Any] = OrderedDict()
_unpickling, _exclusive_use = Lock(), Lock()


def _run(work: Callable[..., Result], exclusive: bool, own: tuple[Any, ...], *packed: Packed) -> Result:
    """Runs the work on a worker, on one thread or, `exclusive`, alone on all threads."""
    from distributed import get_worker

    _keep_freed_memory()
    worker = get_worker()
    shared = [_unpacked(each, worker.address) for each in packed]
    if (torch := sys.modules.get("torch")) is not None and torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    if not exclusive:
        return work(*shared, *own)
    import numba

    settings: Any = numba.config
    with _exclusive_use:
        numba.set_num_threads(min(worker.state.nthreads, settings.NUMBA_NUM_THREADS))
        return work(*shared, *own)


@cache
def _keep_freed_memory() -> None:
    """Undoes the setting of dask's nanny that glibc returns each freed array to the system, which costs a third of a
    bake. These are glibc's own values.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(_M_MMAP_THRESHOLD, LARGEST_KEPT)
        libc.mallopt(_M_TRIM_THRESHOLD, 2 * LARGEST_KEPT)


def _unpacked(packed: Packed, address: str) -> Any:
    """The unpickled object, the same for every block of a process."""
    if (here := _versions()) != packed.versions:
        differences = "; ".join(
            f"expected {package} {there}, found {here[package]}"
            for package, there in packed.versions.items()
            if here[package] != there
        )
        raise ClusterError(f"worker {address}: {differences}; install the expected versions there")
    with _unpickling:
        if packed.name not in _unpickled:
            _unpickled[packed.name] = pickle.loads(packed.content)
        _unpickled.move_to_end(packed.name)
        while len(_unpickled) > SHARED_OBJECTS:
            _unpickled.popitem(last=False)
        return _unpickled[packed.name]
