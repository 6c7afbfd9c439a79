"""Noise of a network's pictures at equal time, with light sampling, lobe sampling and MIS, the pilot included.

    python -m tests.bench.network_render [--size 96] [--spp 256] [--minutes 1] [--only LIGHT ...]
    python -m tests.bench.network_render --model grape.pt --mesh grape.obj --sky indoor.hdr

Lights are the shipped sky, a sun alone, and skies that favour one of the methods; with --sky, that sky rotated to four
sides. An importance module is fitted first if the model has neither one nor lobes of its own. A row has, for each
method, the standard error over the mean radiance on the object at the CPU time of light sampling (medians), the
samples per pixel and second on one thread, and the chosen mixture.
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
from prt_bake.importance.own_lobes import OwnLobes, own_lobes
from prt_bake.lights.environment import read_environment
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.network.bssrdf import load_model
from prt_bake.rendering.network import render_network

SHIPPED = Path(__file__).resolve().parents[2] / "prt_bake" / "shipped"
METHODS = ("light", "lobe", "mis")


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


def rotated(sky: Path) -> dict[str, Lighting]:
    image = read_environment(sky)
    return {f"{sky.stem}, {turn} degrees": as_lighting(image, "y", float(turn)) for turn in (0, 90, 180, 270)}


def module_of(model: Path, mesh: Mesh, minutes: float, module: bool) -> ImportanceModule | OwnLobes:
    """The model's own lobes unless `module`, else its importance module, fitted here if there is none."""
    lobes = own_lobes(load_model(model))
    if lobes is not None and not module:
        return lobes
    if importance_path(model).is_file():
        return load_importance(model)
    with tempfile.TemporaryDirectory() as folder:
        own = Path(shutil.copy(model, folder))
        save_importance(fit_importance(load_model(own), mesh, seconds=60 * minutes, threads=1), own)
        return load_importance(own)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=3, help="repeats of each picture, for median times")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--model", type=Path, default=SHIPPED / "spot.pt")
    parser.add_argument("--mesh", type=Path, default=SHIPPED / "spot.obj", help="the model's object")
    parser.add_argument("--sky", type=Path, help="a lat-long picture that replaces the lights")
    parser.add_argument("--module", action="store_true", help="an importance module even for a network with lobes")
    parser.add_argument("--only", nargs="*", help="names of lights")
    args = parser.parse_args()
    torch.set_num_threads(1)
    mesh, network = read_mesh(args.mesh), load_model(args.model)
    view = camera.fit(mesh, args.size, args.size, view="three-quarter-back")
    module = module_of(args.model, mesh, args.minutes, args.module)
    lights = rotated(args.sky) if args.sky else skies()
    render_network(network, mesh, skies()["grey"], view, 64, importance=module)  # compile
    print(f"{'light':20}{'by light':>10}{'by lobe':>10}{'by MIS':>10}{'of better':>11}  rate, mixture")
    for name, light in lights.items():
        if args.only and name not in args.only:
            continue
        noise, seconds, spp, rate, mixture = {}, {method: [] for method in METHODS}, {}, "", ""
        for _ in range(args.repeats):
            for method in METHODS:
                began = time.process_time()
                picture = render_network(
                    network, mesh, light, view, args.spp, 1, sampling=method, importance=module, background=False
                )
                seconds[method].append(time.process_time() - began)
                noise[method], spp[method] = picture.relative_noise, picture.spp
                mixture = f"{picture.sampling['light']} {picture.sampling['lobe']} trust {picture.sampling['trust']:g}"
        for method in METHODS:
            noise[method] *= np.sqrt(np.median(seconds[method]) / np.median(seconds["light"]))
            rate += f" {spp[method] / np.median(seconds[method]):.3g}"
        ratio = noise["mis"] / max(1e-12, min(noise["light"], noise["lobe"]))
        figures = "".join(f"{noise[method]:10.2%}" for method in METHODS)
        print(f"{name:20}{figures}{ratio:11.2f} {rate}  {mixture}", flush=True)


if __name__ == "__main__":
    main()
