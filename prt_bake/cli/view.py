"""`prtbake view`: shows a baked asset in a window or a browser, with free camera and light."""

import os
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from formats.errors import QueryError
from formats.extras import require
from prt_bake.cli.shared import signals
from prt_bake.cli.shared.fixed import fixed_light
from prt_bake.cli.shared.ineffective import refuse_ineffective
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.options import (
    USUAL_FOV,
    Exposure,
    Eye,
    Fov,
    LookAt,
    Mend,
    Point,
    Reflection,
    Rotate,
    Size,
    Suns,
    ToneMap,
    Up,
    View,
    optional_output,
    read_size,
)
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say

if TYPE_CHECKING:
    from formats.asset import Asset
    from prt_bake.geometry.camera import Camera
    from prt_bake.preview.state import Preview
    from prt_bake.shading.sun_shading import SunTreatment
    from prt_bake.shading.tone_map import ToneMap as ToneMapName

DEFAULT_SIZE = Size(960, 720)
_OF_BROWSER = ("asset", "light", "mend", "browser", "port")
"""The options that --browser takes."""
_WITHOUT_DISPLAY = "there is no display for the window; --screenshot F.png writes the picture without one"


def view(
    context: typer.Context,
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light",
            metavar="LIGHT",
            help="Lat-long sky, lights file (.toml), sun:x,y,z or sphere:x,y,z:radius, as for `prtbake shade`; by "
            "default the shipped sky. Can be repeated: the window switches between the lights and their sum, which "
            "--screenshot shows. Changed files are reloaded.",
            show_default=False,
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="REFERENCE", help="Reference to flip to, such as a path-traced .exr."),
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
            help="Window size in pixels; by default that of --compare, else 960x720.",
            show_default=False,
        ),
    ] = None,
    side: View = None,
    eye: Eye = None,
    look_at: LookAt = None,
    fov: Fov = USUAL_FOV,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    tone_map: ToneMap = "none",
    reflection: Reflection = False,
    up: Up = None,
    mend: Mend = False,
    suns: Suns = "split",
    browser: Annotated[
        bool,
        typer.Option(
            "--browser",
            help="Show it in the browser instead, on the page of `prtbake export ASSET -o FOLDER`, until Ctrl-C; "
            "ASSET may also be a .glb of `prtbake export`.",
        ),
    ] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of --browser on 127.0.0.1; 0 is a free one.")] = 0,
) -> None:
    """Show a baked asset in an interactive window, or in the browser.

    Orbit, rotate the light, flip to a reference, inspect errors and coefficients. Press h in the window for its keys.
    """
    if browser:
        _view_in_browser(context, asset, light, mend, port)
        return
    if port:
        raise typer.BadParameter("--port: has no effect on the window; add --browser")
    refuse_other_kinds({"ASSET": (asset, ("asset",)), "--light": (light, LIGHT), "--compare": (compare, ("sky",))})
    if screenshot is None and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise QueryError(f"view: {_WITHOUT_DISPLAY}")
    check_outputs({"--screenshot": screenshot}, {"ASSET": asset, "--light": light, "--compare": compare})
    options = _Options(
        light, up, rotate, exposure, tone_map, reflection, mend, suns, compare, size, side, eye, look_at, fov
    )
    from formats.asset import read_asset

    with ThreadPoolExecutor(1) as executor:
        # Reading is mostly decompression, which releases the GIL, so that this thread opens the window meanwhile. Only
        # this thread imports: two threads that import modules of a cycle may find them half loaded.
        reading = executor.submit(read_asset, asset)
        window = _load_window()
        if reading.done():
            reading.result()  # an unreadable file is reported before a window opens
        initial = size or DEFAULT_SIZE
        off_screen = screenshot is not None
        plotter = window.open_plotter(initial.width, initial.height, off_screen, f"{asset.name} - prtbake")
        if not off_screen and not window.on_display(plotter):
            raise QueryError(f"view: {_WITHOUT_DISPLAY}")
        plotter.show(auto_close=False, interactive=False)
        opened = _open(reading.result(), options, off_screen)
    print(f"{asset}: error of the coefficients {opened.preview.asset.error}")
    for remark in _remarks(opened.preview, light or []):
        say(f"{asset}: {remark}")
    _show(window, plotter, opened, asset.name, screenshot, compare)


def _view_in_browser(context: typer.Context, asset: Path, lights: list[str] | None, mend: bool, port: int) -> None:
    """Serve the page with an asset, or a .glb, on this machine; print its address, and open it if there is a display.

    Raises typer.BadParameter for options of the window, and what `site_files` and `show_page` raise.
    """
    refuse_ineffective(context, _OF_BROWSER, "on the page of --browser")
    kinds = ("mesh",) if asset.suffix.lower() == ".glb" else ("asset",)
    refuse_other_kinds({"ASSET": (asset, kinds), "--light": (lights, LIGHT)})
    from prt_bake.export.server import show_page
    from prt_bake.export.site import site_files

    files = site_files(asset, lights or (), mend=mend, say=say)
    if show_page(files, port, _print_address):
        signals.record(signal.SIGINT)


def _print_address(address: str) -> None:
    print(address, flush=True)
    say("the page is open for this machine alone; Ctrl-C ends it")


class _Options(NamedTuple):
    """The command's options."""

    light: list[str] | None
    up: str | None
    rotate: float
    exposure: float
    tone_map: "ToneMapName"
    reflection: bool
    mend: bool
    suns: "SunTreatment"
    compare: Path | None
    size: Size | None
    side: str | None
    eye: Point | None
    look_at: Point | None
    fov: float


class _Opened(NamedTuple):
    """The lit asset, the initial camera and the reference picture [H,W,3], if any."""

    preview: "Preview"
    start: "Camera"
    reference: Any


def _open(baked: "Asset", options: _Options, refined: bool) -> _Opened:
    """Light the asset and shade its first picture; `refined` waits for the progressive refinement."""
    from formats.image import read_image
    from prt_bake.cli.shared.viewing import camera_for
    from prt_bake.face.assets import warn_of_other_eye
    from prt_bake.geometry import camera
    from prt_bake.preview.lights import LightSource
    from prt_bake.preview.state import Preview

    light = options.light
    if light is None:
        from prt_bake.shipped.examples import example

        light = [str(example("sky.hdr"))] if baked.quantity == "transfer" else []
    axis = options.up or baked.up
    sources = [LightSource(text, axis, baked.degree, options.mend, say, baked.mesh) for text in light]
    if len(light) > 1:
        both = LightSource(light, axis, baked.degree, options.mend, lambda _: None, baked.mesh)
        sources = [both] if refined else [*sources, both]
    preview = Preview(
        baked,
        sources,
        up=axis,
        rotation=options.rotate,
        exposure=options.exposure,
        suns=options.suns,
        reflecting=options.reflection,
        tone_map=options.tone_map,
    )
    reference = None if options.compare is None else read_image(options.compare)
    shape = options.size or (DEFAULT_SIZE if reference is None else Size(reference.shape[1], reference.shape[0]))
    start = camera_for(baked.mesh, shape, axis, options.side, options.eye, options.look_at, options.fov, False, None)
    camera.refuse_eye_in_object(baked.mesh, start.eye)
    warn_of_other_eye(baked, start.eye)
    if refined:
        preview.refine(start.eye)
    preview.colours(start.eye)
    return _Opened(preview, start, reference)


def _load_window() -> Any:
    require("view", "pyvista")
    from prt_bake.preview import window

    return window


def _show(window: Any, plotter: Any, opened: _Opened, name: str, screenshot: Path | None, compare: Path | None) -> None:
    preview, start, reference = opened
    plotter.window_size = [start.width, start.height]
    scene_view = window.View(preview, plotter, start, reference)
    if screenshot is not None:
        scene_view.refine()
        window.write_picture(screenshot, scene_view.picture())
        print(f"{screenshot}: {start.width}x{start.height} pixels")
    else:
        shown = window.Window(scene_view, name, None if compare is None else compare.name)
        shown.run()
        if shown.interrupted:
            signals.record(shown.interrupted)
    plotter.close()


def _remarks(preview: "Preview", lights: list[str]) -> Iterator[str]:
    """Yield what the asset cannot show."""
    from prt_bake.preview import reasons

    asset = preview.asset
    yield from fixed_light(asset, lights, preview.rotation)
    if not asset.complete:
        yield "is a partial bake; vertices not yet baked are black"
    if preview.reflecting and (reason := reasons.of_reflection(preview)):
        yield reason
