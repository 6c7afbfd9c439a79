"""How fast the preview starts and draws.

    python -m tests.bench.preview [ASSET.h5] [--vertices 10000] [--frames 60] [--starts 5] [--display]

Start: `prtbake view ASSET --screenshot` from the shell to the written picture, best and median of several, and the
time of all processors that it takes. Frames: a window in memory (with --display on the display) with its words and
sliders, orbited by 3 degrees a frame: shading for the new eye, upload of the colours, drawing by VTK; edges as they are
while the mouse moves. Wall times are medians, and what the best tenth of the frames would give; processor time is of
all threads together, which other work on the machine lengthens less. Standing still: what it takes until a sun is met
apart at all vertices that may be seen, and its longest slice, in which nothing else is done.
"""

import argparse
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from prt_bake.geometry import camera
from prt_bake.mathematics import sh
from prt_bake.preview.canvas import Canvas
from prt_bake.preview.lights import LightSource
from prt_bake.preview.refinement import facing
from prt_bake.preview.state import Mode, Preview
from prt_bake.preview.view import View
from prt_bake.preview.window import Window
from tests.shading.assets import asset_of
from tests.shapes import ring

SKY = str(Path(sys.modules["prt_bake"].__file__ or "").parent / "shipped" / "sky.hdr")
SIZES = (640, 480), (960, 720), (1280, 720)
SLICE = 0.02
RINGS, SECTORS, DEGREE = 16, 64, 2


class TimedView(View):
    """A view that notes what shading and upload take, in seconds."""

    shading = uploading = 0.0

    def shade(self) -> NDArray[np.float32] | None:
        """Shade, timed."""
        began = time.perf_counter()
        colours = super().shade()
        self.shading += time.perf_counter() - began
        return colours

    def upload(self, colours: NDArray[np.float32]) -> None:
        """Upload, timed."""
        began = time.perf_counter()
        super().upload(colours)
        self.uploading += time.perf_counter() - began


def made_asset(vertices: int) -> Asset:
    """A torus with the numbers of a real asset: 16 × 64 view bins, degree 2, float16."""
    around = round(math.sqrt(vertices))
    mesh = ring(around=around, across=round(vertices / around))
    block = 0.02 * np.random.default_rng(0).normal(size=(64, RINGS * SECTORS, sh.count(DEGREE), 3))
    block[:, :, 0] += 0.2
    coefficients = np.resize(block.astype(np.float16), (len(mesh.positions), *block.shape[1:]))
    return asset_of(mesh, coefficients, RINGS, SECTORS, DEGREE, provenance={"eta": 1.5, "roughness": 0.2})


def orbit(preview: Preview, size: tuple[int, int], frames: int, display: bool) -> dict[str, float]:
    """Milliseconds a frame by part, and of processors; frames a second."""
    canvas = Canvas(*size, not display)
    view = TimedView(preview, canvas, camera.fit(preview.asset.mesh, *size))
    Window(view, "bench").render()
    view.smooth(False)
    parts = []
    for frame in range(frames + 5):
        canvas.camera.Azimuth(3.0)
        view.shading = view.uploading = 0.0
        began, busy = time.perf_counter(), time.process_time()
        view.window.Render()
        view.window.WaitForCompletion()
        whole = time.perf_counter() - began
        if frame >= 5:
            parts.append((view.shading, view.uploading, whole - view.shading - view.uploading, whole, busy_since(busy)))
    canvas.close()
    middle, best = (1e3 * np.quantile(parts, share, axis=0) for share in (0.5, 0.1))
    names = ("shading", "upload", "VTK", "frame", "processors")
    figures = dict(zip(names, middle.tolist(), strict=True))
    return {**figures, "a second": 1e3 / float(middle[3]), "best tenth a second": 1e3 / float(best[3])}


def busy_since(began: float) -> float:
    """Processor time of this process since, all threads."""
    return time.process_time() - began


def settle(asset: Asset) -> None:
    """Print what it takes to meet a sun apart."""
    preview = Preview(asset, [LightSource("sun:1,2,3", asset.up, asset.degree)])
    preview.load()
    eye = camera.fit(asset.mesh, up=asset.up).eye
    began, slices = time.perf_counter(), [time.perf_counter()]
    while not preview.settle(eye, SLICE):
        slices.append(time.perf_counter())
    ended = time.perf_counter()
    print(
        f"standing still: a sun is met at {int(facing(asset.mesh, eye).sum())} vertices after {ended - began:.2f} s, "
        f"the longest slice {1e3 * max(np.diff([*slices, ended])):.0f} ms"
    )


def start(asset: Path, times: int) -> None:
    """Print what `prtbake view` takes to its first picture."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "prt_bake.cli", "view", str(asset), "--light", SKY, "--screenshot"]
        wall, busy = [], []
        for _ in range(times + 1):
            began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([*command, f"{folder}/first.png"], check=True, stdout=subprocess.DEVNULL)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            wall.append(time.perf_counter() - began)
            busy.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    wall, busy = wall[1:], busy[1:]  # the first one fills the disk's and the compiler's caches
    print(
        f"start: best {min(wall):.2f} s, median {statistics.median(wall):.2f} s; of processors {min(busy):.2f} s "
        f"(load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores)"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path, nargs="?", help="for the start; such as demo/spot.h5")
    parser.add_argument("--vertices", type=int, default=10000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--display", action="store_true", help="frames of a window on the display")
    asked = parser.parse_args()
    if asked.asset is not None:
        start(asked.asset, asked.starts)
    asset = made_asset(asked.vertices)
    preview = Preview(asset, [LightSource(SKY, asset.up, asset.degree)])
    preview.load()
    settle(asset)
    print(f"{len(asset.valid)} vertices, {len(asset.mesh.faces)} faces, milliseconds a frame:")
    for words, choose in (
        ("light and sky", lambda: None),
        ("with reflection", preview.flip_reflection),
        ("coefficients", lambda: preview.show(Mode.COEFFICIENT)),
        ("errors", lambda: preview.show(Mode.ERROR)),
    ):
        choose()
        for size in SIZES:
            figures = orbit(preview, size, asked.frames, asked.display)
            line = "  ".join(f"{name} {value:6.2f}" for name, value in figures.items())
            print(f"{words:<16} {size[0]:>4}x{size[1]}  {line}  (load {os.getloadavg()[0]:.1f})", flush=True)


if __name__ == "__main__":
    main()
