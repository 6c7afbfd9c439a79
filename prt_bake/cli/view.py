"""`prtbake view`: a baked asset in a window that one turns, relights and looks into."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from formats.errors import QueryError, StorageError
from prt_bake.cli.options import Exposure, Eye, Fov, LookAt, Mend, Rotate, Size, Up, optional_output, read_size
from prt_bake.cli.progress import say

if TYPE_CHECKING:
    from prt_bake.camera import Camera
    from prt_bake.preview.state import Preview

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
    fov: Fov = 30.0,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    up: Up = None,
    mend: Mend = False,
) -> None:
    """Look at a baked asset in a window: orbit, turn the light, flip to a reference, see errors and coefficients.

    Press h in the window for its keys.
    """
    if screenshot is None and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise QueryError(f"view: {_WITHOUT_DISPLAY}")
    from prt_bake import camera
    from prt_bake.cli.viewing import camera_for

    with ThreadPoolExecutor(1) as reading:
        # Meanwhile VTK is loaded: both take most of a second.
        coming = reading.submit(_open, asset, light, up, rotate, exposure, mend)
        window = _load_window()
        preview = coming.result()
    reference = None if compare is None else _read(compare)
    shape = size or (DEFAULT_SIZE if reference is None else Size(reference.shape[1], reference.shape[0]))
    mesh, axis = preview.asset.mesh, preview.asset.up
    start = camera_for(mesh, shape, axis, eye, look_at, fov, False, None)
    camera.refuse_eye_in_object(mesh, start.eye)
    for remark in _remarks(preview):
        say(f"{asset}: {remark}")
    _show(window, preview, start, asset.name, screenshot, reference, compare)


def _open(
    asset: Path, light: list[str] | None, up: str | None, rotate: float, exposure: float, mend: bool
) -> "Preview":
    """The asset under its lights, with the colours of its first picture worked out."""
    from importlib import resources

    from formats.asset import read_asset
    from prt_bake import camera
    from prt_bake.preview.lights import LightSource
    from prt_bake.preview.state import Preview

    baked = read_asset(asset)
    if light is None:
        light = [str(resources.files("prt_bake.shipped") / "sky.hdr")] if baked.quantity == "transfer" else []
    axis = up or baked.up
    sources = [LightSource(text, axis, baked.degree, mend, say) for text in light]
    preview = Preview(baked, sources, up=axis, rotation=rotate, exposure=exposure)
    preview.colours(camera.fit(baked.mesh, up=axis).eye)
    return preview


def _load_window() -> Any:
    try:
        from prt_bake.preview import window
    except ModuleNotFoundError as cause:
        if (cause.name or "").partition(".")[0] not in ("pyvista", "vtk", "vtkmodules"):
            raise
        raise StorageError(
            f"view: the window needs {cause.name}, which is not installed; pip install 'prt-bake[preview]'"
        ) from cause
    return window


def _read(path: Path) -> Any:
    from formats.image import read_image

    return read_image(path)


def _show(
    window: Any,
    preview: "Preview",
    start: "Camera",
    name: str,
    screenshot: Path | None,
    reference: Any,
    compare: Path | None,
) -> None:
    plotter = window.make_plotter(start.width, start.height, screenshot is not None)
    drawn = window.View(preview, plotter, start, reference)
    if screenshot is not None:
        window.write_picture(screenshot, drawn.picture())
        print(f"{screenshot}: {start.width}x{start.height} pixels")
    elif not window.has_display(drawn.plotter):
        raise QueryError(f"view: {_WITHOUT_DISPLAY}")
    else:
        window.Window(drawn, name, None if compare is None else compare.name).run()
    plotter.close()


def _remarks(preview: "Preview") -> list[str]:
    """What the asset cannot show."""
    asset = preview.asset
    remarks = [item["reason"] for item in asset.left_out if item["item"] in ("other lights", "other views")]
    if not asset.complete:
        remarks.append("is a partial bake; what was not baked is black")
    return remarks
