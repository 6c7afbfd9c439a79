"""Bakes past one machine: blocks of vertices are done by the workers of a `dask.distributed` scheduler.

The transport and what else blocks have in common goes to the scheduler once, packed, and from there to each worker that
needs it; a worker that dies takes nothing with it that would not be done again elsewhere. Everything is written by the
process that asked. `distributed` is imported where a scheduler is given, and nowhere else.
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
"""Seconds without any worker, after which a cluster is given up."""
ASKED_EVERY = 2.0
"""Seconds between two looks at how many workers there are."""
AHEAD = 2
"""Blocks under way for each thread of the cluster, so that none waits for the next."""
MOST_AHEAD = 1024
OPENED = 8
"""Shared objects that the scheduler holds, and that each worker remembers."""
PACKAGES = "prt-bake", "numpy", "torch", "numba"
"""Of which client and workers must have the same version, that the same numbers come of them."""

LARGEST_KEPT = 32 << 20
"""Bytes of the largest arrays whose memory a worker keeps when they are freed."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


@dataclass(frozen=True)
class Packed:
    """Something that blocks have in common, as it travels."""

    name: str
    content: bytes
    versions: dict[str, str]


class Cluster:
    """A crew of the workers of a scheduler."""

    def __init__(self, client: Any, address: str, alone: bool) -> None:
        """`alone`: one block at a time in each process, on all of its threads."""
        self._client, self._address, self._alone = client, address, alone
        self._lock = Lock()
        self._sent: OrderedDict[int, tuple[Any, Any]] = OrderedDict()
        self._threads, self._asked, self._last_seen = 0, 0.0, time.monotonic()

    @property
    def workers(self) -> int:
        """How many blocks are done at the same time."""
        with self._lock:
            now = time.monotonic()
            if now - self._asked > ASKED_EVERY:
                self._asked, self._threads = now, self._threads_now()
            if self._threads:
                self._last_seen = now
            elif now - self._last_seen > PATIENCE:
                raise ClusterError(
                    f"{self._address}: the scheduler has had no worker for {PATIENCE:.0f} s; start some "
                    f"(dask worker {self._address}) and go on with --resume: finished blocks are kept"
                )
            return max(1, self._threads)

    def _threads_now(self) -> int:
        # A client that has given its scheduler up in the meantime says RuntimeError.
        with _blaming(self._address, OSError, RuntimeError):
            threads = self._client.nthreads().values()
        return len(threads) if self._alone else sum(threads)

    def in_order(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """A few items a worker at a time, more as more workers come."""
        return in_order(work, items, MOST_AHEAD, lambda: min(AHEAD * self.workers, MOST_AHEAD - 1))

    def do(self, work: Callable[..., Result], shared: tuple[Any, ...], *own: Any) -> Result:
        """work(*shared, *own), by one of the workers. Raises what the work does, ClusterError where the cluster is to
        blame.
        """
        from distributed import TimeoutError as NotYet

        packed = [self._at_cluster(one) for one in shared]
        with _blaming(self._address):
            task = self._client.submit(_done, work, self._alone, own, *packed, pure=False)
            while True:
                try:
                    done: Result = task.result(timeout=ASKED_EVERY)
                    return done
                # The other is what `distributed` makes of a question that was cancelled while it ran out of time.
                except (NotYet, UnboundLocalError):
                    if task.status == "error":
                        raise
                    _any = self.workers

    def _at_cluster(self, shared: Any) -> Any:
        """The future of something shared, which is packed and sent when it is first seen."""
        with self._lock:
            if id(shared) not in self._sent:
                packed = _packed(shared)
                with _blaming(self._address):
                    # As a task, not as scattered data: that would be lost with the workers that hold it.
                    future = self._client.submit(Packed, packed.name, packed.content, packed.versions, pure=False)
                # The object is kept, so that no other can take its place in memory.
                self._sent[id(shared)] = shared, future
            self._sent.move_to_end(id(shared))
            while len(self._sent) > OPENED:
                self._sent.popitem(last=False)
            return self._sent[id(shared)][1]


@contextmanager
def opened_cluster(address: str, alone: bool) -> Iterator[Cluster]:
    """The workers of the scheduler at `address`. Raises ClusterError where nobody listens there, where no worker comes
    within a minute, or where `dask.distributed` is not installed.
    """
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise ClusterError(
            "--scheduler: dask.distributed is not installed; install prt-bake[cluster], here and at the workers"
        ) from None

    quiet = {"distributed.admin.large-graph-warning-threshold": sys.maxsize}
    with dask.config.set(quiet), _connected(Client, address) as client:
        crew = Cluster(client, address, alone)
        while not client.nthreads():
            _none_yet = crew.workers
            time.sleep(0.1)
        yield crew


def _connected(client: Any, address: str) -> Any:
    """A `client` of the scheduler at `address`; raises ClusterError where none answers.

    One that failed would close itself when it is collected, under a lock that the next one takes as it begins: where
    the two meet, both wait for ever. So it has a name before it begins, and is closed at once.
    """
    new = client.__new__(client)
    try:
        new.__init__(address, set_as_default=False)
    except (OSError, ValueError, TypeError) as cause:
        new.close()
        raise ClusterError(
            f"--scheduler {address}: no scheduler of dask.distributed answers there ({cause}); expected an address "
            f"such as tcp://host:8786, as `dask scheduler` prints it"
        ) from cause
    return new


@contextmanager
def _blaming(address: str, *gone: type[Exception]) -> Iterator[None]:
    """Tells faults of the cluster from those of the work; `gone` are further ones that tell that it has gone."""
    from concurrent.futures import CancelledError as Cancelled

    from distributed import CancelledError, KilledWorker
    from distributed.client import ClosedClientError
    from distributed.comm.core import CommClosedError

    vanished: tuple[Any, ...] = (CancelledError, Cancelled, CommClosedError, ClosedClientError, *gone)
    try:
        yield
    except PrtbakeError:
        raise
    except KilledWorker as cause:
        raise ClusterError(
            f"{address}: {cause.allowed_failures + 1} workers died one after the other over the same block; see "
            f"whether they have enough memory, and go on with --resume: finished blocks are kept"
        ) from cause
    except vanished as cause:
        raise ClusterError(
            f"{address}: the scheduler has gone; start it and its workers anew and go on with --resume: finished "
            f"blocks are kept"
        ) from cause
    except ImportError as cause:
        raise ClusterError(
            f"{address}: what is needed cannot be imported there ({cause}); install there what is installed here"
        ) from cause


def _packed(shared: Any) -> Packed:
    """Functions within functions are packed as well, and what is defined in the program that was started."""
    import cloudpickle

    content = cloudpickle.dumps(shared, protocol=pickle.HIGHEST_PROTOCOL)
    return Packed(hashlib.sha256(content).hexdigest(), content, _versions())


@cache
def _versions() -> dict[str, str]:
    return {package: version(package) for package in PACKAGES}


_opened: OrderedDict[str, Any] = OrderedDict()
_opening, _only = Lock(), Lock()


def _done(work: Callable[..., Result], alone: bool, own: tuple[Any, ...], *packed: Packed) -> Result:
    """At a worker: the work, on one thread, or on all of its threads and nothing else beside it."""
    from distributed import get_worker

    _keep_freed_memory()
    worker = get_worker()
    shared = [_unpacked(one, worker.address) for one in packed]
    if (torch := sys.modules.get("torch")) is not None and torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    if not alone:
        return work(*shared, *own)
    import numba

    settings: Any = numba.config
    with _only:
        numba.set_num_threads(min(worker.state.nthreads, settings.NUMBA_NUM_THREADS))
        return work(*shared, *own)


@cache
def _keep_freed_memory() -> None:
    """Undoes what dask's nanny asks of glibc: to hand each freed array back to the system, which costs a third of a
    bake. These are the values that glibc comes to by itself.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(_M_MMAP_THRESHOLD, LARGEST_KEPT)
        libc.mallopt(_M_TRIM_THRESHOLD, 2 * LARGEST_KEPT)


def _unpacked(packed: Packed, address: str) -> Any:
    """What was packed, the same object for every block of a process."""
    if (here := _versions()) != packed.versions:
        told = "; ".join(
            f"{package} {there} is needed, found {here[package]}"
            for package, there in packed.versions.items()
            if here[package] != there
        )
        raise ClusterError(f"worker {address}: {told}; install there what is installed here")
    with _opening:
        if packed.name not in _opened:
            _opened[packed.name] = pickle.loads(packed.content)
        _opened.move_to_end(packed.name)
        while len(_opened) > OPENED:
            _opened.popitem(last=False)
        return _opened[packed.name]
