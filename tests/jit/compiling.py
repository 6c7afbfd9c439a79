"""The path tracer's kernels take a minute or two to compile: one process does it while others begin with the tests.

Those wait for it where they first need such a kernel, and compile none themselves.
"""

import fcntl
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests import ROOT

LOCK = "PRT_BAKE_TESTS_COMPILING"
"""The variable that names the file which is locked as long as kernels are compiled."""


def begin() -> subprocess.Popen[bytes]:
    """The process that compiles; processes started after it may wait for it."""
    handle, os.environ[LOCK] = tempfile.mkstemp()
    fcntl.flock(handle, fcntl.LOCK_EX)
    process = subprocess.Popen([sys.executable, "-m", "tests.jit.warm"], pass_fds=[handle], cwd=ROOT)
    os.close(handle)
    return process


def end(process: subprocess.Popen[bytes]) -> None:
    """Raises RuntimeError where the kernels could not be compiled."""
    code = process.wait()
    Path(os.environ.pop(LOCK)).unlink()
    if code != 0:
        raise RuntimeError(f"{process.args} failed with {code}: what it says stands above")


def wait() -> None:
    """Until the kernels are compiled, if any process does that."""
    if LOCK in os.environ:
        with open(os.environ[LOCK]) as file:
            fcntl.flock(file, fcntl.LOCK_SH)


def wait_where_needed() -> None:
    """From now on this process waits before it takes or compiles a kernel of the path tracer."""
    from prt_bake.jit.compilation import KernelCache

    take: Callable[..., Any] = KernelCache.load_overload

    def take_when_compiled(cache: KernelCache, sig: Any, target_context: Any) -> Any:
        if "trainer.kernels" in str(cache.cache_path):
            wait()
        return take(cache, sig, target_context)

    KernelCache.load_overload = take_when_compiled  # type: ignore[method-assign]
