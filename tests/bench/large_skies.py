"""Time and memory of large skies: seconds compared with plain decoding, and the peak memory of commands.

    python -m tests.bench.large_skies [--height 8192] [--asset ASSET.h5] [--kinds zip,piz,none]

A sky twice as wide as high, with a sun, is written for each compression and type. `decode` reads it with OpenEXR,
`project` computes spherical harmonics from the file, and `smaller` also computes the downsampled copy that `shade`
shows behind the object. They alternate in one process; times are medians of 3, with speeds relative to decode. Memory
is the peak of a fresh command-line process; `start` is that for a sky of two pixels.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR

from prt_bake.lights import environment
from prt_bake.lights.skies import downsampled

REPEATS = 3
COMPRESSIONS = {
    "zip": OpenEXR.ZIP_COMPRESSION,
    "zips": OpenEXR.ZIPS_COMPRESSION,
    "piz": OpenEXR.PIZ_COMPRESSION,
    "dwab": OpenEXR.DWAB_COMPRESSION,
    "none": OpenEXR.NO_COMPRESSION,
}
IN_MEMORY = """
import sys
from prt_bake.cli.main import main
code = main(sys.argv[1:])
with open("/proc/self/status") as status:
    print([line.split()[1] for line in status if line.startswith("VmHWM")][0], file=sys.stderr)
sys.exit(code)
"""


def write_sky(path: Path, height: int, kind: str, compression: str) -> None:
    """Write a gradient with waves, 2 % noise and a sun."""
    draw = np.random.default_rng(0)
    v, u = np.linspace(0, 1, height, dtype=np.float32)[:, None], np.linspace(0, 1, 2 * height, dtype=np.float32)
    channels = {}
    for i, name in enumerate("RGB"):
        plane = (0.3 + 0.2 * i) * np.exp(-3 * v) + 0.1 * np.sin(20 * u + i) ** 2 * np.cos(9 * v) ** 2
        plane += 0.02 * draw.random(plane.shape, np.float32)
        plane[height // 3, height // 2] = 5e4
        channels[name] = plane.astype(kind)
    OpenEXR.File({"compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage}, channels).write(str(path))


def seconds(path: Path) -> list[float]:
    """Seconds to decode, to project, and to project with a downsampled copy, each the median of REPEATS."""
    methods: list[Callable[[], object]] = [
        lambda: OpenEXR.File(str(path), separate_channels=True),
        lambda: environment.project(environment.open_environment(path)),
        lambda: downsampled.shrink(environment.open_environment(path), downsampled.rows_shown(480, 30.0), 2),
    ]
    taken = np.zeros((REPEATS, len(methods)))
    for i in range(REPEATS):
        for j, method in enumerate(methods):
            began = time.perf_counter()
            method()
            taken[i, j] = time.perf_counter() - began
    return [float(median) for median in np.median(taken, axis=0)]


def peak(*words: object) -> float:
    """Peak resident memory of a command [MB]."""
    run = subprocess.run(
        [sys.executable, "-c", IN_MEMORY, *map(str, words)], capture_output=True, text=True, check=True
    )
    return int(run.stderr.split()[-1]) / 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=8192, help="rows of the sky")
    parser.add_argument("--asset", type=Path, help="asset to shade under it")
    parser.add_argument("--kinds", default="zip,piz,none", help=f"compressions: {', '.join(COMPRESSIONS)}")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path, picture = Path(folder) / "sky.exr", Path(folder) / "picture.png"
        write_sky(path, 1, "float16", "none")
        shading = ["shade", args.asset, "--light", path, "-o", picture]
        start = peak("light", path), peak(*shading) if args.asset else float("nan")
        print(f"start: light {start[0]:.0f} MB, shade {start[1]:.0f} MB")
        print("sky         decode s  project s (rel. speed)    smaller s (rel. speed)    light MB  shade MB")
        for compression in args.kinds.split(","):
            for kind in ("float16", "float32"):
                write_sky(path, args.height, kind, compression)
                decode, project, smaller = seconds(path)
                memory = peak("light", path), peak(*shading) if args.asset else float("nan")
                print(
                    f"{compression:>4} {kind}  {decode:7.2f}  {project:9.2f} {decode / project:15.2f}  {smaller:9.2f} "
                    f"{decode / smaller:15.2f}  {memory[0]:8.0f}  {memory[1]:8.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
