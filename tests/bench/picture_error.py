"""Whether pictures state their error correctly: bakes of a model with different seeds, under each light.

    python -m tests.bench.picture_error [LIGHT ...] [--rings 4] [--sectors 8] [--samples 64 | --error E] [--bakes 4]
        [--size 64] [--model M.pt --mesh M.ply] [--compress E]

Prints the relative RMSE of the object as stated by the pictures and as measured from their differences, the ratio of
the two, and over pixels the rms of deviation / sigma and the median of sigma / deviation. All three ratios are 1 if the
stated errors are correct. Errors that all bakes share (too few view bins) are in neither.
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
    args = parser.parse_args()
    network, mesh = load_model(args.model), read_mesh(args.mesh)
    bins = {"rings": args.rings, "sectors": args.sectors}
    effort = {"samples": args.samples} if args.error is None else {"error": args.error}
    assets = [bake(network, mesh, seed=seed, **bins, **effort) for seed in range(1, args.bakes + 1)]
    if args.compress:
        assets = [compress(asset, args.compress) for asset in assets]
    view = fit(mesh, args.size, args.size, view="three-quarter-back")
    print(f"{'light':32}{'suns':8}{'stated':>9}{'true':>9}{'ratio':>10}{'rms z':>8}{'median':>8}")
    for name in args.lights:
        lighting = read_lighting([name], "y", mesh=mesh)
        for suns in ("split", "plain"):
            pictures = [render_picture(asset, lighting, view, background=False, suns=suns) for asset in assets]
            inside = pictures[0].coverage > 0.99
            images = np.array([picture.image[inside] for picture in pictures], np.float64)
            stated = np.mean([picture.error[inside].astype(np.float64) ** 2 for picture in pictures], axis=0)
            measured, signal = images.var(axis=0, ddof=1), (images**2).mean(axis=0).sum()
            claimed, true = (np.sqrt(part.sum() / signal) for part in (stated, measured))
            lit = (measured > 0.0) & (stated > 0.0)
            rms = np.sqrt((measured[lit] / stated[lit]).mean())
            median = np.median(np.sqrt(stated[lit] / measured[lit]))
            row = f"{claimed:9.2%}{true:9.2%}{claimed / true:10.2f}{rms:8.2f}{median:8.2f}"
            print(f"{Path(name).name:32}{suns:8}{row}", flush=True)


if __name__ == "__main__":
    main()
