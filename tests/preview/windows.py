"""Windows in memory for the tests of the preview, and the events that a user causes in them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.image import read_image, write_image
from formats.image.png import to_srgb
from prt_bake.geometry import camera
from prt_bake.preview.lights import LightSource
from prt_bake.preview.plotter import open_plotter
from prt_bake.preview.state import Preview
from prt_bake.preview.view import View
from prt_bake.preview.window import Window


def open_window(
    asset: Asset,
    lights: Sequence[str],
    size: tuple[int, int] = (120, 90),
    eye: NDArray[np.float64] | None = None,
    reference: NDArray[np.float32] | None = None,
    **chosen: float,
) -> Window:
    preview = Preview(asset, [LightSource(text, asset.up, asset.degree) for text in lights], **chosen)
    start = camera.fit(asset.mesh, *size, eye=eye, up=asset.up)
    view = View(preview, open_plotter(*size, True), start, reference)
    window = Window(view, "ball.h5", None if reference is None else "reference.exr")
    window.plotter.show(auto_close=False)
    window.render()
    return window


def bare_picture(window: Window) -> NDArray[np.float64]:
    """Return the saved picture, without texts and sliders, in sRGB levels."""
    saved = Path("bare.png").resolve()
    window.save(saved)
    picture = np.rint(255.0 * to_srgb(read_image(saved)))
    saved.unlink()
    return picture


def press(window: Window, *keys: str) -> None:
    interactor = window.plotter.iren.interactor
    for key in keys:
        interactor.SetKeySym(key)
        for event in ("KeyPressEvent", "CharEvent", "KeyReleaseEvent"):
            interactor.InvokeEvent(event)


def mouse(window: Window, place: tuple[int, int], *events: str, shift: bool = False) -> None:
    """Send mouse events at a pixel, counted from the lower left corner."""
    for event in events:
        window.plotter.iren.interactor.SetEventInformation(*place, 0, int(shift), "\0", 0, None)
        window.plotter.iren.interactor.InvokeEvent(event)


def drag(window: Window, start: tuple[int, int], end: tuple[int, int]) -> None:
    mouse(window, start, "LeftButtonPressEvent")
    mouse(window, end, "MouseMoveEvent", "LeftButtonReleaseEvent")


def slide(slider: object, value: float) -> None:
    slider.GetRepresentation().SetValue(value)
    slider.InvokeEvent("InteractionEvent")


def encoded(image: NDArray[np.floating], exposure: float = 0.0) -> NDArray[np.float64]:
    """Return the sRGB levels of a PNG of the image."""
    return np.rint(255.0 * to_srgb(image * 2.0**exposure))


def write_sky(path: Path, sky: NDArray[np.floating]) -> str:
    write_image(path, sky)
    return str(path)
