"""Compiles kernels, and caches them on disk for the next process.

numba's own cache compares a cached kernel with the kernel's own file alone, and concurrent writers may mix kernels up.
This cache compares a digest of the kernel's module and of all our modules that it imports, directly or not. One process
at a time loads or compiles a kernel. Others that need it wait, and load what the first one cached.
"""
# mypy: disallow-untyped-calls=False
# numba has no types.

import hashlib
import os
import re
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from filelock import FileLock
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

ROOT = Path(__file__).resolve().parents[2]
"""The folder of the three packages."""
STARTED = time.time()
"""Time at which this process began. A source that was edited later may differ from what was imported."""
LONGEST_WAIT = 600.0
"""Seconds to wait for another process that compiles a kernel, before compiling it here too."""
_IMPORT = re.compile(r"^(?:from|import) ((?:formats|bakers|prt_bake)\b[\w.]*)(?: import (\([^)]*\)|.*))?", re.MULTILINE)


def compiled(**options: Any) -> Callable[[Kernel], Kernel]:
    """Decorator: numba's `njit` with these options and a cache on disk, for functions at the top of their module.

    The cache is in `NUMBA_CACHE_DIR`, beside the module or in the user's cache folder: the first of these that is
    writable. Kernels are not cached if none is, or if a source was edited after the process began.
    """

    def compile_on_first_call(function: Kernel) -> Kernel:
        kernel: Any = numba.njit(**options)(function)
        # numba raises RuntimeError if no folder is writable. With NUMBA_DISABLE_JIT there is nothing to cache.
        with suppress(RuntimeError, OSError):
            if kernel is not function:
                kernel._cache = KernelCache(function, kernel.compile)
                kernel.compile = kernel._cache.compile
        return cast(Kernel, kernel)

    return compile_on_first_call


class KernelCache(FunctionCache):
    """The cached kernels of one function. Its dispatcher's method `compile_or_load` calls the methods below."""

    def __init__(self, function: Callable[..., Any], compile_or_load: Callable[[Any], Any]) -> None:
        super().__init__(function)
        self._compile_or_load = compile_or_load
        self._source = Path(function.__code__.co_filename).resolve()
        # Without the line number, which is part of numba's name: an edited kernel replaces the old one.
        name = f"{function.__module__}.{function.__qualname__}.{sys.implementation.cache_tag}"
        self._cache_file = IndexDataCacheFile(self.cache_path, name, digest(self._source))
        self._lock = os.path.join(self.cache_path, f"{name}.lock")

    def compile(self, signature: Any) -> Any:
        """The kernel for a signature, loaded or compiled, by one process at a time."""
        # No deadlock: callers are locked before the functions they call, and threads before processes.
        with global_compiler_lock, ExitStack() as held:
            self.disable()
            with suppress(OSError, RuntimeError):
                if all(max(state.st_mtime, state.st_ctime) < STARTED for state in map(os.stat, sources(self._source))):
                    held.enter_context(FileLock(self._lock, LONGEST_WAIT))
                    self.enable()
            return self._compile_or_load(signature)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The cached kernel for this signature, or None."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a damaged file can raise anything
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Caches a kernel, if the cache is writable."""
        with suppress(OSError):
            super().save_overload(sig, data)


class _Notices(event.Listener):
    """Says that our kernels are compiled, and records their times; loading cached kernels is no event.

    The words are imported here and not at the top, where they would be one of the sources of every kernel.
    """

    def __init__(self) -> None:
        self._begun: list[float] = []

    def on_start(self, event: Any) -> None:
        """A kernel, or one that it calls, is going to be compiled."""
        from prt_bake.jit import notice

        self._begun.append(time.monotonic())
        kernel = event.data["dispatcher"]
        if kernel.py_func.__module__.partition(".")[0] == "prt_bake":
            cache_on_disk = getattr(kernel, "_cache", None)
            found = cache_on_disk if isinstance(cache_on_disk, KernelCache) else None
            notice.announce(None if found is None else found.cache_path, found is not None and found._enabled)

    def on_end(self, event: Any) -> None:
        """A kernel was compiled, or could not be."""
        from prt_bake.jit import notice

        begun = self._begun.pop()
        if not self._begun:
            notice.compiled.append((event.data["dispatcher"].py_func.__qualname__, time.monotonic() - begun))


event.register("numba:compile", _Notices())


@cache
def digest(source: Path) -> str:
    """SHA-256 over a module's source and the sources of our modules that it imports, directly or not."""
    return hashlib.sha256(b"".join(hashlib.sha256(path.read_bytes()).digest() for path in sources(source))).hexdigest()


@cache
def sources(source: Path) -> list[Path]:
    """The files of a module and of all our modules that it imports at its top, directly or not."""
    reached, waiting = set[Path](), [source]
    while waiting:
        path = waiting.pop()
        if path not in reached:
            reached.add(path)
            waiting += imported(path)
    return sorted(reached)


@cache
def imported(path: Path) -> list[Path]:
    """The files of our modules that a file imports directly, at its top."""
    found: list[Path] = []
    for package, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
        place = ROOT.joinpath(*package.split("."))
        found += [
            place.with_suffix(".py"),
            place / "__init__.py",
            *(place / f"{name}.py" for name in re.findall(r"\w+", names)),
        ]
    return [file for file in found if file.is_file()]
