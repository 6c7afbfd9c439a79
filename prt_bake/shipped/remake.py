"""How every shipped file was made; `make shipped SKY=potsdamer_platz_1k.hdr` makes them again.

sigma_t.npy, albedo.npy    marble.py
sky.hdr                    the CC0 sky at half size (means of 2 × 2 pixels)
spot.pt                    prtbake train spot.toml -o spot.pt --minutes 60
reference.exr, .json       prtbake render spot.toml spot.obj --light sky.hdr --view three-quarter-back …
"""

import sys
from pathlib import Path

import numpy as np

from formats.image import read_image, write_image
from prt_bake.shipped import marble

HERE = Path(__file__).parent


def downsample_sky(original: Path) -> None:
    """Write sky.hdr, a lat-long sky at half its size."""
    sky = read_image(original).astype(np.float64)
    height, width = sky.shape[0] // 2, sky.shape[1] // 2
    small = sky[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
    write_image(HERE / "sky.hdr", small.astype(np.float32))


if __name__ == "__main__":
    marble.write(HERE)
    downsample_sky(Path(sys.argv[1]))
