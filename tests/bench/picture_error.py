"""Whether pictures are off by what they say: two bakes of the shipped model with other seeds, under each light.

    python tests/bench/picture_error.py [LIGHT ...] [--rings 4] [--sectors 8] [--samples 64] [--size 64]

The told error of the object (relative RMSE, of the two pictures' difference), the same in truth, their quotient, and
the root mean square over pixels of difference / sigma. Where both are 1 the errors are told as they are. What both
bakes have in common (too few view bins) is in neither.
"""

import argparse
from importlib.resources import files
from pathlib import Path

import numpy as np

from prt_bake import bake, load_model, read_lighting, read_mesh
from prt_bake.camera import fit
from prt_bake.shading import render_picture

SHIPPED = Path(str(files("prt_bake.shipped")))
LIGHTS = (str(SHIPPED / "sky.hdr"), "sun:-1,1,-1:5,5,5:0.5", "sun:1,0.2,0:5,5,5:0.5", "sun:0.3,0.2,1:5,5,5:0.5")


def main() -> None:
    """Print a row for each light and treatment of suns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lights", nargs="*", default=LIGHTS)
    for name, usual in (("rings", 4), ("sectors", 8), ("samples", 64), ("size", 64)):
        parser.add_argument(f"--{name}", type=int, default=usual)
    asked = parser.parse_args()
    network, mesh = load_model(SHIPPED / "spot.pt"), read_mesh(SHIPPED / "spot.obj")
    bins = {"rings": asked.rings, "sectors": asked.sectors, "samples": asked.samples}
    assets = [bake(network, mesh, seed=seed, **bins) for seed in (1, 2)]
    view = fit(mesh, asked.size, asked.size)
    print(f"{'light':32}{'suns':8}{'told':>9}{'true':>9}{'quotient':>10}{'rms z':>8}")
    for name in asked.lights:
        lighting = read_lighting([name], "y", mesh=mesh)
        for suns in ("split", "plain"):
            pictures = [render_picture(asset, lighting, view, background=False, suns=suns) for asset in assets]
            inside = pictures[0].coverage > 0.99
            images = np.array([picture.image[inside] for picture in pictures], np.float64)
            sigma = np.hypot(*(picture.error[inside].astype(np.float64) for picture in pictures))
            difference, signal = images[0] - images[1], np.sqrt((images**2).sum())
            told, true = (np.sqrt((part**2).sum()) / signal for part in (sigma, difference))
            off = np.sqrt(((difference / sigma) ** 2).mean())
            print(f"{Path(name).name:32}{suns:8}{told:9.2%}{true:9.2%}{told / true:10.2f}{off:8.2f}", flush=True)


if __name__ == "__main__":
    main()
