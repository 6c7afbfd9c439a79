"""The tests of kernels for graphics cards, in a process of their own: Triton brings an LLVM with it, and so does the
OpenGL that windows are drawn with where there is no card; a process that has drawn and then loads Triton goes down.
"""

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
APART = Path(sys.prefix) / "apart"
"""Where `make test` installs Triton: in the environment itself torch would load it."""


def test_kernels_answer_and_are_left_out_where_they_should() -> None:
    command = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-p", "no:cacheprovider", "--color=no", "kernels"]
    found = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(APART))))
    done = subprocess.run(
        command, cwd=HERE, env={**os.environ, "PYTHONPATH": found}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
