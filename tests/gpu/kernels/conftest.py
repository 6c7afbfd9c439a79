"""Kernels for graphics cards are interpreted where there is no card; Triton looks at this once, when it is imported."""

import os
from pathlib import Path

if not Path("/dev/nvidiactl").exists():
    os.environ["TRITON_INTERPRET"] = "1"
