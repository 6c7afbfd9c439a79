"""Whether pictures are off by what they say: bakes of a model with other seeds, under each light.

    python -m tests.bench.picture_error [LIGHT ...] [--rings 4] [--sectors 8] [--samples 64 | --error E] [--bakes 4]
        [--size 64] [--model M.pt --mesh M.ply] [--compress E]

The told error of the object (relative RMSE of a picture), the same in truth, by how much the pictures differ, their
quotient, and over pixels the root mean square of deviation / sigma and the median of sigma / deviation, both those of a
pixel over all bakes. Where all are 1 the errors are told as they are. What all bakes have in common (too few view bins)
is in neither.
"""

import argparse
from importlib.resources import files
from pathlib import Path

import numpy as np

from prt_bake import bake, compress, load_model, read_lighting, read_mesh
from prt_bake.geometry.camera import fit
from prt_bake.shading.picture import render_picture

SHIPPED = Path(str(files("prt_bake.shipped")))
LIGHTS = (str(SHIPPED / "sky.hdr"), "sun:-1,1,-1:5,5,5:0.5", "sun:1,0.2,0:5,5,5:0.5", "sun:0.3,0.2,1:5,5,5:0.5")


def main() -> None:
    """Print a row for each light and treatment of suns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lights", nargs="*", default=LIGHTS)
    for name, usual in (("rings", 4), ("sectors", 8), ("samples", 64), ("size", 64)):
        parser.add_argument(f"--{name}", type=int, default=usual)
    parser.add_argument("--bakes", type=int, default=4)
    parser.add_argument("--error", type=float, help="bake to this error in place of fixed samples")
    parser.add_argument("--compress", type=float, help="compress the assets to this error")
    parser.add_argument("--model", default=SHIPPED / "spot.pt")
    parser.add_argument("--mesh", default=SHIPPED / "spot.obj")
    asked = parser.parse_args()
    network, mesh = load_model(asked.model), read_mesh(asked.mesh)
    bins = {"rings": asked.rings, "sectors": asked.sectors}
    way = {"samples": asked.samples} if asked.error is None else {"error": asked.error}
    assets = [bake(network, mesh, seed=seed, **bins, **way) for seed in range(1, asked.bakes + 1)]
    if asked.compress:
        assets = [compress(asset, asked.compress) for asset in assets]
    view = fit(mesh, asked.size, asked.size)
    print(f"{'light':32}{'suns':8}{'told':>9}{'true':>9}{'quotient':>10}{'rms z':>8}{'median':>8}")
    for name in asked.lights:
        lighting = read_lighting([name], "y", mesh=mesh)
        for suns in ("split", "plain"):
            pictures = [render_picture(asset, lighting, view, background=False, suns=suns) for asset in assets]
            inside = pictures[0].coverage > 0.99
            images = np.array([picture.image[inside] for picture in pictures], np.float64)
            stated = np.mean([picture.error[inside].astype(np.float64) ** 2 for picture in pictures], axis=0)
            seen, signal = images.var(axis=0, ddof=1), (images**2).mean(axis=0).sum()
            told, true = (np.sqrt(part.sum() / signal) for part in (stated, seen))
            lit = (seen > 0.0) & (stated > 0.0)
            off = np.sqrt((seen[lit] / stated[lit]).mean())
            usual = np.median(np.sqrt(stated[lit] / seen[lit]))
            row = f"{told:9.2%}{true:9.2%}{told / true:10.2f}{off:8.2f}{usual:8.2f}"
            print(f"{Path(name).name:32}{suns:8}{row}", flush=True)


if __name__ == "__main__":
    main()
