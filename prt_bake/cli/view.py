"""`prtbake view`: a baked asset in a window that one turns, relights and looks into."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from formats.errors import QueryError, StorageError
from prt_bake.cli.shared.options import (
    USUAL_FOV,
    Exposure,
    Eye,
    Fov,
    LookAt,
    Mend,
    Point,
    Rotate,
    Size,
    Suns,
    Up,
    optional_output,
    read_size,
)
from prt_bake.cli.shared.progress import say

if TYPE_CHECKING:
    from formats.asset import Asset
    from prt_bake.geometry.camera import Camera
    from prt_bake.preview.state import Preview
    from prt_bake.shading.suns import SunTreatment

DEFAULT_SIZE = Size(960, 720)
_WITHOUT_DISPLAY = "there is no display to open a window on; --screenshot F.png writes the picture without one"


def view(
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light",
            metavar="LIGHT",
            help="Lat-long sky, lights file (.toml) or sun:x,y,z, as for `prtbake shade`; given several times, each is "
            "one to go through. Files are read again when they change. By default the sky that comes with prtbake.",
            show_default=False,
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="REFERENCE", help="Picture to flip to and back, such as a path-traced .exr."),
    ] = None,
    screenshot: Annotated[
        Path | None,
        optional_output("--screenshot", "F.png", "Write the first picture, without a window or a display.", ".png"),
    ] = None,
    size: Annotated[
        Size | None,
        typer.Option(
            parser=read_size,
            metavar="WxH",
            help="Pixels of the window; by default those of --compare, else 960x720.",
            show_default=False,
        ),
    ] = None,
    eye: Eye = None,
    look_at: LookAt = None,
    fov: Fov = USUAL_FOV,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    up: Up = None,
    mend: Mend = False,
    suns: Suns = "split",
) -> None:
    """Look at a baked asset in a window: orbit, turn the light, flip to a reference, see errors and coefficients.

    Press h in the window for its keys.
    """
    if screenshot is None and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise QueryError(f"view: {_WITHOUT_DISPLAY}")
    asked = _Asked(light, up, rotate, exposure, mend, suns, compare, size, eye, look_at, fov)
    from formats.asset import read_asset

    with ThreadPoolExecutor(1) as reading:
        # Meanwhile everything else is loaded: most of reading is unpacking, which needs nothing of Python. All imports
        # are this thread's: where two load a library whose modules import one another, either may find it half loaded.
        coming = reading.submit(read_asset, asset)
        window = _load_window()
        if coming.done():
            coming.result()  # what could not be opened is told without a window
        first = size or DEFAULT_SIZE
        canvas = window.Canvas(first.width, first.height, screenshot is not None, f"{asset.name} - prtbake")
        if screenshot is None and not canvas.on_display:
            raise QueryError(f"view: {_WITHOUT_DISPLAY}")
        canvas.open()
        opened = _open(coming.result(), asked, screenshot is not None)
    for remark in _remarks(opened.preview):
        say(f"{asset}: {remark}")
    _show(window, canvas, opened, asset.name, screenshot, compare)


class _Asked(NamedTuple):
    """What the command line says of what is to be seen."""

    light: list[str] | None
    up: str | None
    rotate: float
    exposure: float
    mend: bool
    suns: "SunTreatment"
    compare: Path | None
    size: Size | None
    eye: Point | None
    look_at: Point | None
    fov: float


class _Opened(NamedTuple):
    """What is shown, from where, and beside which picture [H,W,3]."""

    preview: "Preview"
    start: "Camera"
    reference: Any


def _open(baked: "Asset", asked: _Asked, settled: bool) -> _Opened:
    """The asset under its lights, with the colours of its first picture worked out; `settled` as after a while."""
    from prt_bake.cli.shared.viewing import camera_for
    from prt_bake.geometry import camera
    from prt_bake.preview.lights import LightSource
    from prt_bake.preview.state import Preview

    light = asked.light
    if light is None:
        from importlib import resources

        light = [str(resources.files("prt_bake.shipped") / "sky.hdr")] if baked.quantity == "transfer" else []
    axis = asked.up or baked.up
    sources = [LightSource(text, axis, baked.degree, asked.mend, say, baked.mesh) for text in light]
    preview = Preview(baked, sources, up=axis, rotation=asked.rotate, exposure=asked.exposure, suns=asked.suns)
    reference = None if asked.compare is None else _read(asked.compare)
    shape = asked.size or (DEFAULT_SIZE if reference is None else Size(reference.shape[1], reference.shape[0]))
    start = camera_for(baked.mesh, shape, axis, asked.eye, asked.look_at, asked.fov, False, None)
    camera.refuse_eye_in_object(baked.mesh, start.eye)
    if settled:
        preview.settle(start.eye)
    preview.colours(start.eye)
    return _Opened(preview, start, reference)


def _load_window() -> Any:
    try:
        from prt_bake.preview import window
    except ModuleNotFoundError as cause:
        if (cause.name or "").partition(".")[0] not in ("vtk", "vtkmodules"):
            raise
        raise StorageError(
            "view: the window needs VTK, which is not installed; pip install 'prt-bake[preview]'"
        ) from cause
    return window


def _read(path: Path) -> Any:
    from formats.image import read_image

    return read_image(path)


def _show(window: Any, canvas: Any, opened: _Opened, name: str, screenshot: Path | None, compare: Path | None) -> None:
    preview, start, reference = opened
    canvas.resize(start.width, start.height)
    drawn = window.View(preview, canvas, start, reference)
    if screenshot is not None:
        drawn.settle()
        window.write_picture(screenshot, drawn.picture())
        print(f"{screenshot}: {start.width}x{start.height} pixels")
    else:
        window.Window(drawn, name, None if compare is None else compare.name).run()
    canvas.close()


def _remarks(preview: "Preview") -> list[str]:
    """What the asset cannot show."""
    asset = preview.asset
    remarks = [item["reason"] for item in asset.left_out if item["item"] in ("other lights", "other views")]
    if not asset.complete:
        remarks.append("is a partial bake; what was not baked is black")
    return remarks
