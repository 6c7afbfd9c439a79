"""Downsamples a lat-long sky without losing energy: `python -m scenes.shrink SKY OUT.hdr --size 256x128`.

Each pixel is the mean of those that it replaces, weighted by their solid angles, so that the integral of radiance over
each pixel is preserved.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.image import read_image, write_image


def shrink(sky: NDArray[np.floating], width: int, height: int) -> NDArray[np.float64]:
    """Return the sky [H,W,3] at `width` × `height`; raises ValueError unless H and W are multiples of them."""
    rows, columns = sky.shape[0] // height, sky.shape[1] // width
    if (rows * height, columns * width) != sky.shape[:2] or not rows * columns:
        raise ValueError(
            f"the sky is {sky.shape[1]}x{sky.shape[0]}, not a multiple of {width}x{height}; choose another --size"
        )
    edges = np.cos(np.pi * np.arange(sky.shape[0] + 1) / sky.shape[0])
    weights = (edges[:-1] - edges[1:]).reshape(height, rows)
    blocks = sky.astype(np.float64).reshape(height, rows, width, columns, 3).mean(axis=3)
    return np.einsum("hr,hrwc->hwc", weights / weights.sum(axis=1, keepdims=True), blocks)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Downsample a lat-long sky without losing energy.")
    parser.add_argument("sky", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", default="256x128")
    arguments = parser.parse_args()
    width, height = (int(part) for part in arguments.size.split("x"))
    write_image(arguments.out, shrink(read_image(arguments.sky), width, height))
