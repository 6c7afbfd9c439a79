"""A lat-long sky in fewer pixels, its energy kept: `python -m scenes.shrink SKY OUT.hdr --size 256x128`.

Each pixel becomes the mean of those that it takes the place of, weighted by the solid angle of each: radiance times
solid angle is the same before and after, of every pixel and so of the whole.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.image import read_image, write_image


def shrink(sky: NDArray[np.floating], width: int, height: int) -> NDArray[np.float64]:
    """The sky [H,W,3] at `width` × `height`; H and W must be whole multiples of them.

    Raises ValueError where they are not.
    """
    rows, columns = sky.shape[0] // height, sky.shape[1] // width
    if (rows * height, columns * width) != sky.shape[:2] or not rows * columns:
        raise ValueError(
            f"the sky is {sky.shape[1]}x{sky.shape[0]}, no whole multiple of {width}x{height}; give another --size"
        )
    edges = np.cos(np.pi * np.arange(sky.shape[0] + 1) / sky.shape[0])
    weights = (edges[:-1] - edges[1:]).reshape(height, rows)
    blocks = sky.astype(np.float64).reshape(height, rows, width, columns, 3).mean(axis=3)
    return np.einsum("hr,hrwc->hwc", weights / weights.sum(axis=1, keepdims=True), blocks)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Shrink a lat-long sky; its energy stays.")
    parser.add_argument("sky", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", default="256x128")
    given = parser.parse_args()
    across, down = (int(part) for part in given.size.split("x"))
    write_image(given.out, shrink(read_image(given.sky), across, down))
