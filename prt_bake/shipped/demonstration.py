"""The demonstration: shipped model → asset → relit picture, compared with a path-traced reference."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.atomic import create_folder
from formats.image import read_image, write_image
from formats.json_report import write_report
from formats.mesh import read_mesh
from prt_bake.baking.bake import Progress, bake
from prt_bake.baking.job.sample_pilot import LADDER, error_ladder
from prt_bake.baking.report.summary import bake_report, plot_error
from prt_bake.comparison.metrics import Comparison, compare
from prt_bake.comparison.side_by_side import write_side_by_side
from prt_bake.geometry import camera
from prt_bake.lights.environment import read_environment
from prt_bake.network.bssrdf import load_model
from prt_bake.shading.picture import Picture, render_picture
from prt_bake.trainer.learning.precision import bfloat16_is_faster

SHIPPED = Path(str(resources.files("prt_bake.shipped")))
MODEL, MESH, SKY = SHIPPED / "spot.pt", SHIPPED / "spot.obj", SHIPPED / "sky.hdr"
REFERENCE, REFERENCE_REPORT = SHIPPED / "reference.exr", SHIPPED / "reference.json"
"""A path-traced picture of the scene under the sky, and its report by `prtbake render --report`."""
FILES = ("spot.h5", "spot.png", "spot.exr", "comparison.png", "error.png", "report.json")
"""The names of the files that a demonstration writes."""


@dataclass(frozen=True)
class Settings:
    """Quality settings of a demonstration."""

    error: float
    """Relative RMSE of the coefficients, of the object and of 95 % of its vertices."""
    rounded: bool
    """Whether to compute matrix products in bfloat16 if the processor is faster with it."""
    magnification: int
    """Width of the picture relative to the reference."""
    exposure: float = 0.0

    @property
    def precision(self) -> str:
        """Number type of matrix products on this processor."""
        return "bfloat16" if self.rounded and bfloat16_is_faster("cpu") else "float32"


QUICK = Settings(error=0.05, rounded=True, magnification=1)
FINE = Settings(error=0.01, rounded=False, magnification=2)


@dataclass(frozen=True)
class Demonstration:
    """The files and figures of a demonstration.

    `comparison` covers the whole picture with the sky; `object_comparison` the pixels that the object covers
    completely. `noise_mse` is the mean squared standard error of the reference on the object.
    """

    asset: Asset
    files: tuple[Path, ...]
    comparison: Comparison
    object_comparison: Comparison
    noise_mse: float
    ladder: NDArray[np.float64]
    """Rows (seconds, evaluations, estimated relative error) of bakes with equally many directions in every bin."""


def demonstrate(
    folder: Path,
    settings: Settings = QUICK,
    workers: int = 1,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Demonstration:
    """Bake the shipped model, relight the asset under the shipped sky, and compare the picture with the reference.

    Writes spot.h5, spot.png, spot.exr, comparison.png, error.png and report.json into `folder`, which is created. The
    pictures of Spot include the surface reflection; the comparison does not.

    Raises StorageError if `folder` cannot be written.
    """
    create_folder(folder)
    asset = _bake(folder / "spot.h5", settings, workers, progress, stop)
    reference_report = json.loads(REFERENCE_REPORT.read_text(encoding="utf-8"))
    reflecting = _relight(asset, reference_report, settings.magnification, reflection=True)
    write_image(folder / "spot.exr", reflecting.image)
    write_image(folder / "spot.png", reflecting.image, exposure=settings.exposure)
    # The reference contains subsurface light alone.
    picture = _relight(asset, reference_report, settings.magnification, reflection=False)
    reference = read_image(REFERENCE)
    small, coverage = (
        _downsampled(image, settings.magnification) for image in (picture.image, picture.coverage[..., None])
    )
    whole = compare(small, reference, exposure=settings.exposure)
    inside = compare(small, reference, coverage[..., 0] >= 1.0, settings.exposure)
    write_side_by_side(small, reference, whole.flip_map, folder / "comparison.png", settings.exposure)
    ladder = error_ladder(
        load_model(MODEL),
        read_mesh(MESH),
        samples=LADDER,
        precision=settings.precision,
        workers=workers,
        baked=asset,
    )
    plot_error(ladder, asset.error_vs_time, folder / "error.png")
    figures = {"picture": whole.as_json(), "object": inside.as_json(), "reference": reference_report}
    write_report({"bake": bake_report(asset), **figures, "clamped": picture.clamped}, folder / "report.json")
    return Demonstration(
        asset, tuple(folder / name for name in FILES), whole, inside, reference_report["noise_mse"], ladder
    )


def _bake(
    output: Path, settings: Settings, workers: int, progress: Progress | None, stop: Callable[[], bool] | None
) -> Asset:
    return bake(
        load_model(MODEL),
        read_mesh(MESH),
        error=settings.error,
        out=output,
        precision=settings.precision,
        workers=workers,
        progress=progress,
        stop=stop,
        provenance={"command": "prtbake demo", "source": MODEL.name, "mesh": MESH.name},
    )


def _relight(asset: Asset, reference: dict[str, Any], magnification: int, reflection: bool) -> Picture:
    """Render the asset under the shipped sky with the reference's camera."""
    view = camera.Camera(
        np.array(reference["eye"]),
        np.array(reference["target"]),
        np.array(reference["up"]),
        reference["fov"],
        magnification * reference["width"],
        magnification * reference["height"],
    )
    return render_picture(asset, read_environment(SKY), view, reflection=reflection)


def _downsampled(image: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Box-filter blocks of factor × factor pixels."""
    height, width, channels = image.shape
    blocks = image.reshape(height // factor, factor, width // factor, factor, channels)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)
