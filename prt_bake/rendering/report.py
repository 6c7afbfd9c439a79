"""The report of a path-traced picture."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.rendering.state import relative_noise

if TYPE_CHECKING:
    from prt_bake.geometry.camera import Camera


def rendering_report(
    camera: "Camera",
    image: NDArray[np.float32],
    standard_error: NDArray[np.float32],
    coverage: NDArray[np.float32],
    history: NDArray[np.float64],
) -> dict[str, Any]:
    """Camera and noise of a path-traced picture [H,W,3], as plain JSON values.

    Noise is measured over the pixels that the object covers completely. `noise_mse` is the mean squared standard error,
    `relative_noise` its root over the mean radiance, `error_vs_time` the rows of `history` [rows,3].
    """
    noise = np.asarray(standard_error[coverage >= 1.0], np.float64)
    return {
        "width": camera.width,
        "height": camera.height,
        "eye": camera.eye.tolist(),
        "target": camera.target.tolist(),
        "up": camera.up.tolist(),
        "fov": camera.fov,
        "noise_mse": float(np.mean(noise**2)) if noise.size else 0.0,
        "relative_noise": relative_noise(image, standard_error, coverage),
        "error_vs_time": {"columns": ["seconds", "walks", "relative noise"], "rows": history.tolist()},
    }
