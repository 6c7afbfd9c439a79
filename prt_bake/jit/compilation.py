"""How kernels are compiled, and where numba's results are kept for the next process.

A compiled kernel holds all that it calls, so an edit to any source that it draws on makes it stale; numba itself looks
at the kernel's own file alone. Here a kernel is kept in a folder named by a digest of its module and of every module of
ours that this one imports, one after the other. An edit meets an empty folder and never an old kernel. A file holds one
kernel for one signature and processor, is named by a digest of both, and appears by renaming: processes that compile at
once write files that are as good as one another, in any order.
"""

import hashlib
import os
import pickle
import platform
import re
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numba
from numba.core import config
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

ROOT = Path(__file__).resolve().parent.parent
"""Where the three packages lie."""
STATES_KEPT = 4
"""How many digests of a module keep their folders: those written last."""
# numba's own functions, which carry no types.
_rebuild: Callable[..., Any] = CompileResult._rebuild
_as_bytes: Callable[[Any], bytes] = dumps
_directories: Callable[..., Any] = AppDirs
_OURS = r"(?:formats|bakers|prt_bake)"
_IMPORT = re.compile(rf"^(?:import ({_OURS}[\w.]*)|from ({_OURS}[\w.]*) import (\([^)]*\)|[^#\n]*))", re.MULTILINE)


def compiled(**options: Any) -> Callable[[Kernel], Kernel]:
    """numba's `njit` with these options, kept between processes; for functions at the top of their module.

    Where no folder can be written to, and where a source was edited after the process began, kernels are compiled anew
    and not kept.
    """

    def compile_on_first_call(function: Kernel) -> Kernel:
        dispatcher: Any = numba.njit(**options)(function)
        dispatcher._cache = KernelCache(function)
        return cast(Kernel, dispatcher)

    return compile_on_first_call


class KernelCache(_Cache):
    """The compiled forms of one function, as numba's dispatcher asks for them."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._source = Path(function.__code__.co_filename).resolve()
        self._name = f"{function.__name__}-{function.__code__.co_firstlineno}"
        self._digest = digest_at_start(self._source)
        self._folder = _folder_of(self._source, self._digest)
        self._enabled = self._folder is not None

    @property
    def cache_path(self) -> str | None:
        """The folder, or None where there is none to write to."""
        return None if self._folder is None else str(self._folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel kept for this signature, or None."""
        target_context.refresh()
        if not self._usable():
            return None
        # A file that is missing or damaged is compiled again.
        with suppress(OSError, EOFError, pickle.UnpicklingError):
            kept = pickle.loads(self._path(sig, target_context.codegen()).read_bytes())
            return _rebuild(target_context, *kept)
        return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Keep a kernel; where it cannot be kept it is compiled again next time."""
        if cres.lifted or cres.library.has_dynamic_globals or not self._usable():
            return
        path = self._path(sig, cres.codegen)
        part = path.with_name(f".{path.name}.{os.getpid()}-{os.urandom(4).hex()}")
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True, exist_ok=True)
                _drop_old_states(path.parent)
            part.write_bytes(_as_bytes(cres._reduce()))
            part.replace(path)
        except OSError:
            with suppress(OSError):
                part.unlink(missing_ok=True)

    def enable(self) -> None:
        """Use the folder."""
        self._enabled = self._folder is not None

    def disable(self) -> None:
        """Compile anew, and keep nothing."""
        self._enabled = False

    def flush(self) -> None:
        """Forget every kept form of the function."""
        if self._folder is not None:
            for path in self._folder.glob(f"{self._name}-*.kernel"):
                path.unlink(missing_ok=True)

    def _usable(self) -> bool:
        return self._enabled and digest(self._source) == self._digest

    def _path(self, signature: Any, codegen: Any) -> Path:
        key = repr((signature, codegen.magic_tuple(), numba.__version__, sys.implementation.cache_tag))
        assert self._folder is not None
        return self._folder / f"{self._name}-{hashlib.sha256(key.encode()).hexdigest()[:24]}.kernel"


def digest(source: Path) -> str:
    """A digest of a module's text and of those that it imports, as they are now; "" where one cannot be read."""
    try:
        texts = [_read(path).text_digest for path in modules_reached(source)]
    except OSError:
        return ""
    return hashlib.sha256(b"".join(texts)).hexdigest()[:16]


@cache
def digest_at_start(source: Path) -> str:
    """`digest` when it was first asked for: while the module was being imported."""
    return digest(source)


def modules_reached(source: Path) -> list[Path]:
    """The files of a module and of every module of ours that it imports at its top, those of these, and so on."""
    reached, waiting = {source}, [source]
    while waiting:
        for path in _read(waiting.pop()).imported:
            if path not in reached:
                reached.add(path)
                waiting.append(path)
    return sorted(reached)


class _Source(NamedTuple):
    text_digest: bytes
    imported: tuple[Path, ...]


def _read(path: Path) -> _Source:
    state = path.stat()
    return _read_once(path, state.st_mtime_ns, state.st_size)


@cache
def _read_once(path: Path, modified: int, size: int) -> _Source:
    """`modified` and `size` tell one state of the file from the next."""
    text = path.read_bytes()
    found: list[Path] = []
    for plain, package, names in _IMPORT.findall(text.decode("utf-8")):
        place = ROOT.joinpath(*(plain or package).split("."))
        inside = [place / f"{name}.py" for name in re.findall(r"\w+", names)]
        found += [path for path in (place.with_suffix(".py"), *inside) if path.is_file()]
    return _Source(hashlib.sha256(text).digest(), tuple(found))


def _folder_of(source: Path, state: str) -> Path | None:
    """Where kernels of a module in this state are kept: beside the packages, or else in the user's own cache."""
    if not state:
        return None
    name = f"{source.parent.name}.{source.stem}-{state}"
    base = _writable_base()
    return None if base is None else base / name


@cache
def _writable_base() -> Path | None:
    settings: Any = config
    chosen = settings.CACHE_DIR
    bases = [Path(chosen) / "prtbake"] if chosen else []
    bases += [ROOT / "prt_bake" / "__pycache__", Path(_directories("prtbake", appauthor=False).user_cache_dir)]
    for base in bases:
        with suppress(OSError, RuntimeError):
            folder = base / f"kernels-{platform.machine()}"
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK):
                return folder
    return None


def _drop_old_states(newest: Path) -> None:
    """Remove all but the last few states of the module whose folder is `newest`; who still uses one compiles again."""
    module = newest.name.rpartition("-")[0]
    states = [path for path in newest.parent.glob(f"{module}-*") if path != newest]
    with suppress(OSError):
        states.sort(key=lambda path: path.stat().st_mtime, reverse=True)
        for path in states[STATES_KEPT - 1 :]:
            shutil.rmtree(path, ignore_errors=True)
