"""The tests of kernels for graphics cards, in a process of their own: Triton brings an LLVM with it, and so does the
OpenGL that windows are drawn with where there is no card; whichever is loaded second brings the process down.
"""

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def test_kernels_answer_and_are_left_out_where_they_should() -> None:
    command = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-p", "no:cacheprovider", "--color=no", "on_card"]
    done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
