"""Time to open an asset in C, and of a frame, by `engines/example.c`.

    python -m tests.bench.open_in_c spot.h5

Processor time of one thread, the file being in the system's cache: the least of five runs.
"""

import argparse
import re
import shlex
import subprocess
import tempfile
from pathlib import Path

from tests import ROOT

RUNS = 5


def main() -> None:
    parser = argparse.ArgumentParser(prog="open_in_c.py", description=__doc__)
    parser.add_argument("asset", type=Path, metavar="ASSET")
    path = parser.parse_args().asset
    with tempfile.TemporaryDirectory() as folder:
        package = subprocess.run(
            ["pkg-config", "--cflags", "--libs", "hdf5"], capture_output=True, text=True, check=True
        )
        program = Path(folder) / "example"
        options = ["-O2", *shlex.split(package.stdout), "-lm", "-o", program]
        subprocess.run(["cc", ROOT / "engines/example.c", *options], check=True)
        printed = [
            subprocess.run([program, path], capture_output=True, text=True, check=True).stdout for _ in range(RUNS)
        ]
    opened = min(float(figure) for text in printed for figure in re.findall(r"vertices in (\S+) s", text))
    frame = min(float(figure) for text in printed for figure in re.findall(r"^(\S+) ms", text, re.MULTILINE))
    print(f"{path.name}, {path.stat().st_size / 1e6:.0f} MB: opened in {opened:.2f} s, a frame in {frame:.1f} ms")
    print(printed[0].splitlines()[0])


if __name__ == "__main__":
    main()
