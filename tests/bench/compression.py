"""Compression of assets: size, error and seconds, and the time to shade compact and plain assets.

    python -m tests.bench.compression ASSET.h5 [--errors 0.005,0.01,0.02]
    python -m tests.bench.compression --model MODEL.pt --mesh MESH [--error 0.01]

The asset is a file, or baked first to an error. Shading is `shade_vertices` at every vertex with a new light and a new
view each time, the median of 15; reading is from the file to the asset.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.fft import dct

from formats.asset import Asset, read_asset
from prt_bake.baking.compress import compress_file
from prt_bake.mathematics import sh
from prt_bake.shading.picture import shade_vertices

REPEATS = 15


def timed(work: Callable[[], object]) -> float:
    """Milliseconds, median."""
    work()
    taken = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return 1e3 * float(np.median(taken))


def shading(asset: Asset) -> float:
    draw = np.random.default_rng(0)
    vertices = len(asset.valid)

    def shade_again() -> None:
        light = draw.normal(size=(sh.count(asset.degree), 3)) if asset.quantity == "transfer" else None
        shade_vertices(asset, light, draw.normal(size=(vertices, 3)))

    return timed(shade_again)


def reading(path: Path) -> tuple[Asset, float]:
    began = time.perf_counter()
    asset = read_asset(path)
    return asset, time.perf_counter() - began


def detail(asset: Asset) -> float:
    """RMS of the finest detail (periods below two rings and below four of 64 sectors) over the RMS of all detail.

    It is 1 for white noise.
    """
    fine = total = 0.0
    for first in range(0, len(asset.valid), 64):
        block = np.asarray(asset.coefficients[first : first + 64], np.float64)
        spectrum = dct(block.reshape(len(block), asset.rings, asset.sectors, -1), axis=1, norm="ortho")
        squares = np.abs(np.fft.fft(spectrum, axis=2, norm="ortho")) ** 2
        quick = np.abs(np.fft.fftfreq(asset.sectors)) >= 0.25
        fine += float(squares[:, asset.rings // 2 :, quick].sum())
        total += float(squares.sum())
    return float(np.sqrt(fine / total / (0.5 * quick.mean())))


def measure(path: Path, errors: list[float], folder: Path) -> None:
    plain, seconds = reading(path)
    shape = "×".join(map(str, plain.coefficients.shape))
    print(f"{path.name}: {shape}, read in {seconds:.2f} s, shaded in {shading(plain):.2f} ms")
    if plain.coefficients.shape[1] == plain.rings * plain.sectors:
        print(f"    fine detail of the view {detail(plain):.2%}")
    del plain
    names = ("bytes", 13), ("ratio", 8), ("added", 9), ("p95", 8), ("worst", 8), ("seconds", 9), ("read s", 8)
    print(f"{'error':>8}" + "".join(f"{name:>{width}}" for name, width in names) + f"{'shade ms':>10}")
    for error in errors:
        outcome = compress_file(path, folder / "compact.h5", error)
        compact, seconds = reading(folder / "compact.h5")
        if outcome.compact is None:
            print(f"{error:8.2%}  is not smaller")
            continue
        added = outcome.compact.added
        print(
            f"{error:8.2%}{outcome.after:13,}{outcome.raw / outcome.after:8.1f}{added.total:9.3%}"
            f"{added.percentile_95:8.2%}{added.worst:8.2%}{outcome.seconds:9.1f}{seconds:8.2f}{shading(compact):10.2f}",
            flush=True,
        )
    for row in outcome.asset.provenance.get("compression", {}).get("tried", ()):
        print(f"    {row['form']:<24}{row['size']:13,}  error {row['error']:.3%}, {row['seconds']:.1f} s")


def baked(model: Path, mesh: Path, error: float, folder: Path) -> Path:
    from formats.mesh import read_mesh
    from prt_bake import bake, load_model

    path = folder / f"{model.stem}.h5"
    bake(load_model(model), read_mesh(mesh), error=error, out=path).close()
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path, nargs="?")
    parser.add_argument("--model", type=Path)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--error", type=float, default=0.01, help="error of the bake")
    parser.add_argument("--errors", default="0.005,0.01,0.02", help="errors of the compression")
    args = parser.parse_args()
    if args.asset is None and (args.model is None or args.mesh is None):
        parser.error("give an asset, or a model and a mesh")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = args.asset or baked(args.model, args.mesh, args.error, folder)
        measure(path, [float(error) for error in args.errors.split(",")], folder)


if __name__ == "__main__":
    main()
