"""What `--verbose` adds for a report of a defect: versions, where warnings and errors come from, compilation, time."""

import os
import platform
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from formats.version import program_version
from prt_bake.jit import notice

_LIBRARIES = ("numpy", "numba", "embreex", "trimesh", "h5py", "OpenEXR", "torch", "vtk", "pyvista")

_enabled = False


def detail(sentence: str) -> None:
    """Print a sentence on stderr, with `--verbose` only."""
    if _enabled:
        print(f"prtbake: {sentence}", file=sys.stderr, flush=True)


def error_detail() -> None:
    """Print the traceback of the error that is being handled, with `--verbose` only."""
    if _enabled:
        traceback.print_exc()


@contextmanager
def verbosely(enabled: bool) -> Iterator[None]:
    """Context of a command that prints details if `enabled`: versions before it, times after it."""
    global _enabled
    _enabled = enabled
    started = time.monotonic()
    if enabled:
        detail(_versions())
    try:
        yield
    finally:
        if notice.compiled:
            detail(f"compiled kernels in {notice.seconds():.1f} s")
        detail(f"{time.monotonic() - started:.1f} s in all")
        _enabled = False


def _versions() -> str:
    libraries = [f"{name} {version}" for name in _LIBRARIES if (version := _version(name))]
    parts = f"Python {platform.python_version()}", platform.platform(), f"{os.cpu_count()} cores"
    return ", ".join((f"prtbake {program_version()}", *parts, *libraries))


def _version(library: str) -> str:
    import importlib.metadata  # here, since it is slow

    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return ""
