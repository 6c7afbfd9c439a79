"""How kernels are compiled, and how numba's cache keeps them for the next process.

numba checks a kept kernel against the kernel's own file alone, and processes that write at once may mix kernels up.
Here a kernel is checked against a digest of its module and of all our modules that this one imports, directly or not.
One process at a time loads or compiles a kernel. Others that need it wait, and load what the first one kept.
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
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

ROOT = Path(__file__).resolve().parents[2]
"""The folder of the three packages."""
STARTED = time.time()
"""A source that is younger may differ from what this process has imported."""
LONGEST_WAIT = 600.0
"""Seconds after which a process compiles a kernel itself although another still does."""
_IMPORT = re.compile(r"^(?:from|import) ((?:formats|bakers|prt_bake)\b[\w.]*)(?: import (\([^)]*\)|.*))?", re.MULTILINE)


def compiled(**options: Any) -> Callable[[Kernel], Kernel]:
    """numba's `njit` with these options, kept between processes; for functions at the top of their module.

    Kernels are kept in `NUMBA_CACHE_DIR`, beside the module or in the user's cache: the first that can be written to.
    Where there is none, and where a source was edited after the process began, they are compiled anew and not kept.
    """

    def compile_on_first_call(function: Kernel) -> Kernel:
        kernel: Any = numba.njit(**options)(function)
        # numba raises RuntimeError where no folder can be written to. With NUMBA_DISABLE_JIT there is nothing to keep.
        with suppress(RuntimeError, OSError):
            if kernel is not function:
                kernel._cache = KernelCache(function, kernel.compile)
                kernel.compile = kernel._cache.compile
        return cast(Kernel, kernel)

    return compile_on_first_call


class KernelCache(FunctionCache):
    """The kept forms of one function. `compile_or_load` is its dispatcher's method, which calls the methods below."""

    def __init__(self, function: Callable[..., Any], compile_or_load: Callable[[Any], Any]) -> None:
        super().__init__(function)
        self._compile_or_load = compile_or_load
        self._source = Path(function.__code__.co_filename).resolve()
        # Without the line, by which numba tells functions apart: an edited kernel replaces the old one.
        name = f"{function.__module__}.{function.__qualname__}.{sys.implementation.cache_tag}"
        self._cache_file = IndexDataCacheFile(self.cache_path, name, digest(self._source))
        self._lock = os.path.join(self.cache_path, f"{name}.lock")

    def compile(self, signature: Any) -> Any:
        """The kernel for a signature, loaded or compiled, by one process at a time."""
        # Callers are locked before what they call, and the lock of threads before those of processes: no circle waits.
        with global_compiler_lock, ExitStack() as held:
            self.disable()
            with suppress(OSError, RuntimeError):
                if all(max(state.st_mtime, state.st_ctime) < STARTED for state in map(os.stat, sources(self._source))):
                    held.enter_context(FileLock(self._lock, LONGEST_WAIT))
                    self.enable()
            return self._compile_or_load(signature)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel kept for this signature, or None."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a damaged file can raise anything
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a kernel; where it cannot be kept it is compiled again next time."""
        with suppress(OSError):
            super().save_overload(sig, data)


@cache
def digest(source: Path) -> str:
    """A digest of a module's text and of those that it imports, as this process has them."""
    return hashlib.sha256(b"".join(hashlib.sha256(path.read_bytes()).digest() for path in sources(source))).hexdigest()


@cache
def sources(source: Path) -> list[Path]:
    """The files of a module and of every module of ours that it imports at its top, those of these, and so on."""
    reached, waiting = set[Path](), [source]
    while waiting:
        path = waiting.pop()
        if path not in reached:
            reached.add(path)
            waiting += imported(path)
    return sorted(reached)


@cache
def imported(path: Path) -> list[Path]:
    """The files of our modules that a file imports at its top."""
    found: list[Path] = []
    for package, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
        place = ROOT.joinpath(*package.split("."))
        found += [
            place.with_suffix(".py"),
            place / "__init__.py",
            *(place / f"{name}.py" for name in re.findall(r"\w+", names)),
        ]
    return [file for file in found if file.is_file()]
