"""Whether noise-corrected figures are independent of the pictures' noise: Spot at 16, 64 and 256 walks per pixel.

    python -m tests.bench.noise_free_comparison [--size 96] [--seeds 2] [--reference 2048]

Each path-traced picture is compared with a reference of other random numbers over Spot's pixels: unchanged (the true
figures are zero), and multiplied by waves of 30 % and a tint (the true figures are those of the multiplied reference
against itself). Prints each figure as measured and corrected for noise with its interval, an asterisk if the interval
misses the truth, and the seconds of the correction.
"""

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from formats.mesh import read_mesh
from formats.scene import read_scene
from prt_bake.comparison.metrics import compare
from prt_bake.comparison.noise import PixelErrors
from prt_bake.comparison.noise_free import compare_without_noise
from prt_bake.geometry import camera
from prt_bake.lights.environment import read_environment
from prt_bake.rendering.loop import Rendering
from prt_bake.rendering.scene import render_scene
from prt_bake.shipped.demonstration import MESH, SKY

SPP = (16, 64, 256)
FIGURES = ("mse", "relative_mse", "relative_rmse", "ssim", "ssim_quarter", "flip", "hdr_flip")
EXPOSURES = (-1.0, 3.0)


def picture(spp: int, size: int, seed: int) -> Rendering:
    """Spot under the shipped sky."""
    scene = read_scene(MESH.with_suffix(".toml"))
    return render_scene(
        scene, read_environment(SKY), camera.fit(read_mesh(MESH), size, size, view="three-quarter-back"), spp, seed
    )


def waves(size: int) -> NDArray[np.float64]:
    """Factors [H,W,3] of 0.7 to 1.3, and a tint."""
    y, x = np.mgrid[:size, :size] / size
    return (1.0 + 0.3 * np.sin(9.0 * x + 4.0 * y))[..., None] * np.array([1.0, 1.1, 0.9])


def main() -> None:
    """Print a row for each picture and figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--reference", type=int, default=2048)
    args = parser.parse_args()
    reference = picture(args.reference, args.size, 1000)
    mask, target = reference.coverage >= 1.0, reference.image.astype(np.float64)
    for name, factor in (("unchanged", np.ones_like(target)), ("waves", waves(args.size))):
        exact = compare(factor * target, target, mask, hdr=EXPOSURES)
        print(f"{name}: truth " + ", ".join(f"{figure} {getattr(exact, figure):.4g}" for figure in FIGURES))
        for spp in SPP:
            for seed in range(args.seeds):
                noisy = picture(spp, args.size, spp + seed)
                image, sigma = factor * noisy.image, factor * noisy.standard_error
                found = compare(image, target, mask, hdr=EXPOSURES)
                errors = PixelErrors(sigma, reference.standard_error.astype(np.float64), np.zeros_like(target))
                begun = time.perf_counter()
                free = compare_without_noise(image, target, errors, mask, hdr=found.hdr_exposures)
                seconds = time.perf_counter() - begun
                print(f"  {spp} walks per pixel, seed {spp + seed}, {seconds:.1f} s")
                for figure in FIGURES:
                    interval, true = free.figures[figure], getattr(exact, figure)
                    missed = "" if not np.isfinite(interval.low) or interval.low <= true <= interval.high else " *"
                    print(
                        f"    {figure:<14} {getattr(found, figure):<10.4g} without noise {interval.value:.4g} "
                        f"({interval.low:.4g} to {interval.high:.4g}){missed}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
