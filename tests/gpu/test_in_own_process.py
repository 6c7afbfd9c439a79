"""Runs the tests of GPU kernels in a separate process.

Triton contains an LLVM, and so does the software OpenGL that draws windows without a GPU. A process that has drawn and
then loads Triton crashes.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
TRITON_FOLDER = Path(sys.prefix) / "apart"
"""The folder in which `make test` installs Triton: in the environment itself torch would load it."""


@pytest.mark.statistics
def test_simulated_gpu() -> None:
    """numba simulates a GPU in processes that it starts with a variable of the environment."""
    command = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-p", "no:cacheprovider", "--color=no", "simulated"]
    done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]


@pytest.mark.statistics
def test_gpu_kernels() -> None:
    command = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-p", "no:cacheprovider", "--color=no", "kernels"]
    path = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(TRITON_FOLDER))))
    done = subprocess.run(
        command, cwd=HERE, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
