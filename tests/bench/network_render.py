"""Noise of a network's pictures at equal time, sampled by light, lobe and both, the pilot included.

    python -m tests.bench.network_render [--size 96] [--spp 256] [--minutes 1] [--only LIGHT ...]
    python -m tests.bench.network_render --model grape.pt --mesh grape.obj --sky indoor.hdr

The shipped Spot, model and sky, a sun on its own, and skies in which one of the ways has the upper hand; with --sky,
that sky from four sides instead. An importance module is fitted first where the model has none beside it. A row gives,
for each way, standard error over mean radiance on the object at the CPU time that the first took (medians); samples a
pixel a second on one thread; the mixture chosen.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from formats.mesh import Mesh, read_mesh
from formats.scene.lights import parse_sun
from prt_bake.geometry import camera
from prt_bake.importance.fit import fit_importance
from prt_bake.importance.module import ImportanceModule, importance_path, load_importance, save_importance
from prt_bake.lights.environment import read_environment
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.network.bssrdf import load_model
from prt_bake.rendering.network import render_network

SHIPPED = Path(__file__).resolve().parents[2] / "prt_bake" / "shipped"
WAYS = ("light", "lobe", "mis")


def skies() -> dict[str, Lighting]:
    outdoor = read_environment(SHIPPED / "sky.hdr")
    sunny = outdoor.copy()
    sunny[20:22, 60:62] = 1e5
    grey = np.ones((64, 128, 3), np.float32)
    lamp = grey.copy()
    lamp[20:24, 40:44] = 150.0
    dark_lamp = 0.02 * grey
    dark_lamp[30:34, 90:96] = 30.0
    behind = grey.copy()
    behind[:, 50:110] = 20.0
    images = {
        "shipped sky": outdoor,
        "with a sun of 1e5": sunny,
        "grey": grey,
        "grey with a lamp": lamp,
        "dark with a lamp": dark_lamp,
        "bright behind": behind,
    }
    return {name: as_lighting(image, "y", 0.0) for name, image in images.items()} | {
        "one sun": Lighting((), (parse_sun("sun:0.5,0.6,-0.6:3,3,3"),))
    }


def turned(sky: Path) -> dict[str, Lighting]:
    image = read_environment(sky)
    return {f"{sky.stem}, {turn} degrees": as_lighting(image, "y", float(turn)) for turn in (0, 90, 180, 270)}


def module_of(model: Path, mesh: Mesh, minutes: float) -> ImportanceModule:
    """The model's importance module, fitted here where there is none."""
    if importance_path(model).is_file():
        return load_importance(model)
    with tempfile.TemporaryDirectory() as folder:
        own = Path(shutil.copy(model, folder))
        save_importance(fit_importance(load_model(own), mesh, seconds=60 * minutes, threads=1), own)
        return load_importance(own)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=3, help="of each picture, for the median of the times")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--model", type=Path, default=SHIPPED / "spot.pt")
    parser.add_argument("--mesh", type=Path, default=SHIPPED / "spot.obj", help="the object that it was learnt from")
    parser.add_argument("--sky", type=Path, help="a lat-long picture instead of the lights above")
    parser.add_argument("--only", nargs="*", help="some of the lights")
    given = parser.parse_args()
    torch.set_num_threads(1)
    mesh, network = read_mesh(given.mesh), load_model(given.model)
    view = camera.fit(mesh, given.size, given.size)
    module = module_of(given.model, mesh, given.minutes)
    lights = turned(given.sky) if given.sky else skies()
    render_network(network, mesh, skies()["grey"], view, 64, importance=module)  # what is compiled is compiled
    print(f"{'light':20}{'by light':>10}{'by lobe':>10}{'by both':>10}{'of better':>11}  rate, mixture")
    for name, light in lights.items():
        if given.only and name not in given.only:
            continue
        noise, seconds, spp, rate, mixture = {}, {way: [] for way in WAYS}, {}, "", ""
        for _ in range(given.repeats):
            for way in WAYS:
                began = time.process_time()
                picture = render_network(
                    network, mesh, light, view, given.spp, 1, sampling=way, importance=module, background=False
                )
                seconds[way].append(time.process_time() - began)
                noise[way], spp[way] = picture.relative_noise, picture.spp
                mixture = f"{picture.sampling['light']} {picture.sampling['lobe']} trust {picture.sampling['trust']:g}"
        for way in WAYS:
            noise[way] *= np.sqrt(np.median(seconds[way]) / np.median(seconds["light"]))
            rate += f" {spp[way] / np.median(seconds[way]):.3g}"
        ratio = noise["mis"] / max(1e-12, min(noise["light"], noise["lobe"]))
        figures = "".join(f"{noise[way]:10.2%}" for way in WAYS)
        print(f"{name:20}{figures}{ratio:11.2f} {rate}  {mixture}", flush=True)


if __name__ == "__main__":
    main()
