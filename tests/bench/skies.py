"""An asset's pictures compared with path-traced ones under several skies: overcast, indoor, studio, sun, or any other.

    python -m tests.bench.skies SCENE.toml ASSET.h5 [--skies overcast.hdr indoor.hdr …] [--spp 256] [--out FOLDER]

The sky `studio` (a dark room with three soft boxes of 10° to 40°) is generated, others are files. References are
rendered with `spp` walks per pixel and kept as `FOLDER/scene.sky.exr`. Pictures show the object alone, without and with
surface reflection. Figures are over the fully covered pixels, at an exposure that maps the 95th percentile of the
reference to white: FLIP, FLIP corrected for the reference's noise with its interval, relative RMSE, the reference's
noise, the share of clamped light, and the seconds of both pictures. `FOLDER/scene.sky.png` shows both and their FLIP.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import prt_bake as prt
from formats.asset import Asset
from formats.image import read_layers
from prt_bake.comparison.metrics import compare
from prt_bake.comparison.noise import PixelErrors
from prt_bake.comparison.noise_free import compare_without_noise
from prt_bake.comparison.side_by_side import write_side_by_side
from prt_bake.geometry import camera
from prt_bake.lights.environment import direction_of
from prt_bake.shading.picture import render_picture

Array = NDArray[np.float64]

BOXES = (((-0.7, 0.5, -0.6), 20.0, 30.0), ((0.9, 0.2, -0.3), 40.0, 6.0), ((0.2, 0.6, 1.0), 10.0, 60.0))
"""Direction, half angle in degrees, radiance."""


def studio() -> Array:
    """A lat-long sky [256,512,3]."""
    v, u = ((np.indices((256, 512)) + 0.5).T / (512, 256)[::-1]).T
    towards = direction_of(u, v)
    sky = np.full((256, 512, 3), 0.03)
    for direction, degrees, radiance in BOXES:
        middle = np.array(direction) / np.linalg.norm(direction)
        sky[towards @ middle > np.cos(np.radians(degrees))] += radiance
    return sky


def reference(path: Path, scene: prt.Scene, light: prt.Lighting, view: camera.Camera, spp: int, gloss: bool) -> Path:
    """Render the path-traced picture unless it exists, and write its seconds beside it."""
    if not path.exists():
        begun = time.perf_counter()
        traced = prt.render_scene(scene, light, view, spp, shown="scattered", background=False, reflection=gloss)
        layers = {"error": traced.standard_error, "coverage": traced.coverage}
        prt.write_image(path, traced.image, layers=layers)
        path.with_suffix(".txt").write_text(f"{time.perf_counter() - begun:.1f}")
    return path


def row(asset: Asset, light: prt.Lighting, view: camera.Camera, path: Path, gloss: bool) -> str:
    """One line of the table; writes the pictures side by side."""
    layers = read_layers(path)
    shape = layers.image.shape
    truth, sigma = layers.image.astype(np.float64), layers.layers["error"].reshape(shape).astype(np.float64)
    mask = layers.layers["coverage"].reshape(shape[:2]) >= 1.0
    begun = time.perf_counter()
    shaded = render_picture(asset, light, view, background=False, reflection=gloss)
    seconds = time.perf_counter() - begun
    exposure = -np.log2(np.quantile(truth[mask].max(axis=1), 0.95))
    measured = compare(shaded.image, truth, mask, exposure)
    none = np.zeros(shape)
    free = compare_without_noise(shaded.image, truth, PixelErrors(none, sigma, none), mask, exposure).figures
    write_side_by_side(shaded.image, layers.image, measured.flip_map, path.with_suffix(".png"), exposure)
    noise = np.sqrt((sigma[mask] ** 2).mean()) / truth[mask].mean()
    error = np.sqrt(((shaded.image - truth)[mask] ** 2).mean()) / truth[mask].mean()
    flip = free["flip"]
    return (
        f"FLIP {measured.flip:.4f}, without noise {flip.value:.4f} [{flip.low:.4f}, {flip.high:.4f}]"
        f"  rmse {error:.1%}, noise {noise:.1%}  clamped {abs(shaded.clamped):.2%}"
        f"  {seconds:.1f} s; path traced {path.with_suffix('.txt').read_text()} s"
    )


def main() -> None:
    """Print two lines for each sky."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--skies", nargs="+", default=["studio"])
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--out", type=Path, default=Path("bench"))
    parser.add_argument("--without-reflection", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    asset, scene = prt.read_asset(args.asset), prt.load_scene(args.scene)
    view = camera.fit(scene.mesh, args.size, args.size, view="three-quarter-back")
    for sky in args.skies:
        name = Path(sky).stem
        if sky == "studio":
            prt.write_image(args.out / "studio.exr", studio())
        light = prt.read_lighting([str(args.out / "studio.exr") if sky == "studio" else sky])
        for gloss in (False,) if args.without_reflection else (False, True):
            stem = f"{args.scene.stem}.{name}{'.reflection' if gloss else ''}"
            path = reference(args.out / f"{stem}.exr", scene, light, view, args.spp, gloss)
            print(f"{stem}: {row(asset, light, view, path, gloss)}", flush=True)


if __name__ == "__main__":
    main()
