"""Start-up time and frame rate of the preview.

    python -m tests.bench.preview [ASSET.h5] [--vertices 10000] [--frames 60] [--starts 5] [--display]

Start-up: `prtbake view ASSET --screenshot` from the shell to the written picture, best and median of several runs, wall
time and processor time. Frames: an off-screen window (with --display on the display) with its text and sliders, orbited
by 3 degrees per frame: shading for the new eye, upload of the colours, drawing, with the edges of a moving view.
Wall times are medians, frame rates those of the median and of the best tenth of the frames. Processor time is of
all threads together, and other processes affect it less. Refinement at rest: the time until a sun is shaded separately
at all visible vertices, and its longest slice, during which the window does not respond.
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
from prt_bake.preview.lights import LightSource
from prt_bake.preview.plotter import open_plotter
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
    """A view that records the seconds of shading and upload."""

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


def make_asset(vertices: int) -> Asset:
    """A torus of the size of a real asset: 16 × 64 view bins, degree 2, float16."""
    around = round(math.sqrt(vertices))
    mesh = ring(around=around, across=round(vertices / around))
    block = 0.02 * np.random.default_rng(0).normal(size=(64, RINGS * SECTORS, sh.count(DEGREE), 3))
    block[:, :, 0] += 0.2
    coefficients = np.resize(block.astype(np.float16), (len(mesh.positions), *block.shape[1:]))
    return asset_of(mesh, coefficients, RINGS, SECTORS, DEGREE, provenance={"eta": 1.5, "roughness": 0.2})


def orbit(preview: Preview, size: tuple[int, int], frames: int, display: bool) -> dict[str, float]:
    """Milliseconds per frame by stage, processor time included; frames per second."""
    plotter = open_plotter(*size, not display)
    view = TimedView(preview, plotter, camera.fit(preview.asset.mesh, *size, view="three-quarter-back"))
    window = Window(view, "bench")
    plotter.show(auto_close=False, interactive=False)
    window.render()
    parts = []
    for frame in range(frames + 5):
        plotter.camera.Azimuth(3.0)
        view.shading = view.uploading = 0.0
        began, busy = time.perf_counter(), time.process_time()
        plotter.render()
        plotter.render_window.WaitForCompletion()
        frame_time = time.perf_counter() - began
        if frame >= 5:
            drawing = frame_time - view.shading - view.uploading
            parts.append((view.shading, view.uploading, drawing, frame_time, time.process_time() - busy))
    plotter.close()
    middle, best = (1e3 * np.quantile(parts, share, axis=0) for share in (0.5, 0.1))
    names = ("shading", "upload", "drawing", "frame", "processors")
    figures = dict(zip(names, middle.tolist(), strict=True))
    return {**figures, "per second": 1e3 / float(middle[3]), "best tenth per second": 1e3 / float(best[3])}


def refine(asset: Asset) -> None:
    """Print the time until a sun is shaded separately at all visible vertices."""
    preview = Preview(asset, [LightSource("sun:1,2,3", asset.up, asset.degree)])
    preview.load()
    eye = camera.fit(asset.mesh, up=asset.up, view="three-quarter-back").eye
    began, slices = time.perf_counter(), [time.perf_counter()]
    while not preview.refine(eye, SLICE):
        slices.append(time.perf_counter())
    ended = time.perf_counter()
    print(
        f"at rest: a sun is shaded at {int(facing(asset.mesh, eye).sum())} vertices after {ended - began:.2f} s, "
        f"the longest slice {1e3 * max(np.diff([*slices, ended])):.0f} ms"
    )


def start(asset: Path, times: int) -> None:
    """Print the time of `prtbake view` to its first picture."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "prt_bake.cli", "view", str(asset), "--light", SKY, "--screenshot"]
        wall, busy = [], []
        for _ in range(times + 1):
            began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([*command, f"{folder}/first.png"], check=True, stdout=subprocess.DEVNULL)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            wall.append(time.perf_counter() - began)
            busy.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    wall, busy = wall[1:], busy[1:]  # the first run fills the disk's and the compiler's caches
    print(
        f"start: best {min(wall):.2f} s, median {statistics.median(wall):.2f} s; processor time {min(busy):.2f} s "
        f"(load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores)"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path, nargs="?", help="asset for the start-up time, such as demo/spot.h5")
    parser.add_argument("--vertices", type=int, default=10000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--display", action="store_true", help="use a window on the display")
    args = parser.parse_args()
    if args.asset is not None:
        start(args.asset, args.starts)
    asset = make_asset(args.vertices)
    preview = Preview(asset, [LightSource(SKY, asset.up, asset.degree)])
    preview.load()
    refine(asset)
    print(f"{len(asset.valid)} vertices, {len(asset.mesh.faces)} faces, milliseconds per frame:")
    for mode, choose in (
        ("light and sky", lambda: None),
        ("with reflection", preview.toggle_reflection),
        ("coefficients", lambda: preview.show(Mode.COEFFICIENT)),
        ("errors", lambda: preview.show(Mode.ERROR)),
    ):
        choose()
        for size in SIZES:
            figures = orbit(preview, size, args.frames, args.display)
            line = "  ".join(f"{name} {value:6.2f}" for name, value in figures.items())
            print(f"{mode:<16} {size[0]:>4}x{size[1]}  {line}  (load {os.getloadavg()[0]:.1f})", flush=True)


if __name__ == "__main__":
    main()
