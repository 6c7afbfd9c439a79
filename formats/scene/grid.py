"""Grids of a medium, `.npy` (https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html).

Arrays [Z,Y,X] or [Z,Y,X,3] with values at the cell centres of a box.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import existing
from formats.errors import SceneError
from formats.file_names import named_file


def read_grid(scene_path: Path, key: str, name: str, highest: float) -> NDArray[np.float64]:
    """Read a grid that a scene file names, and check that its values are between 0 and `highest`.

    Args:
        scene_path: the scene file; `name` is relative to its folder.
        key: the key that names the grid in the scene file, for messages.
        name: the grid file.
        highest: the largest allowed value; infinity allows every finite one.

    Raises:
        SceneError: not an `.npy` file, not a real array of these shapes, values NaN or out of range (the message has
            their count and the first).
        StorageError: the file is missing.
    """
    path = existing(named_file(scene_path, name))
    try:
        grid = np.load(path, allow_pickle=False)
    except Exception as cause:  # damaged headers raise errors of many classes, tokenize.TokenError among them
        raise SceneError(f"{scene_path}: {key}: {path} is not an .npy array, or is truncated; save it again") from cause
    if not isinstance(grid, np.ndarray):
        raise SceneError(f"{scene_path}: {key}: {path} is an archive of arrays (.npz); save its array alone, as .npy")
    if grid.dtype.kind not in "fiu":
        raise SceneError(f"{scene_path}: {key}: {path} does not hold real numbers; expected one .npy array of floats")
    if grid.ndim not in (3, 4) or 0 in grid.shape or (grid.ndim == 4 and grid.shape[3] != 3):
        raise SceneError(
            f"{scene_path}: {key}: {path} has shape {list(grid.shape)}; expected a grid [Z,Y,X] or [Z,Y,X,3]"
        )
    grid = np.ascontiguousarray(grid, np.float64)
    invalid = ~((grid >= 0) & (grid <= highest) & np.isfinite(grid))
    if invalid.any():
        first = tuple(int(i) for i in np.argwhere(invalid)[0])
        expected = f"from 0 to {highest:g}" if np.isfinite(highest) else "finite and not negative"
        raise SceneError(
            f"{scene_path}: {key}: {path} has {invalid.sum()} of {grid.size} values out of range, the first at "
            f"[{', '.join(map(str, first))}] is {grid[first]:g}; expected values {expected}"
        )
    return grid
