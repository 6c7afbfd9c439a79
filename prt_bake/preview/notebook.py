"""The preview in a notebook: a picture above sliders for the light, the exposure and the eye (ipywidgets)."""

import io
import math
from typing import Any

import ipywidgets
import numpy as np
from PIL import Image

from prt_bake.preview.view import View
from prt_bake.preview.window import SLIDER_EXPOSURE

_STEEPEST = 85.0
"""Of the eye, in degrees above or below the object."""


def controls(view: View) -> Any:
    """Return the widget that shows the view; its picture is drawn again when a slider moves."""
    preview, start = view.preview, view.start
    away = start.eye - start.target
    height = math.degrees(math.asin(float(away @ start.up / np.linalg.norm(away))))
    light = _slider("light", preview.rotation, 180.0, 5.0)
    exposure = _slider("exposure", preview.exposure, SLIDER_EXPOSURE, 0.25)
    around, above = _slider("around", 0.0, 180.0, 5.0), _slider("above", height, _STEEPEST, 5.0)
    reflection = ipywidgets.Checkbox(preview.reflecting, description="reflection")
    agx = ipywidgets.Checkbox(preview.tone_map == "agx", description="AgX")
    picture = ipywidgets.Image(format="png")
    sliders = [light, exposure, around, above] if preview.relightable else [exposure, around, above]
    shown = [*sliders, agx, reflection] if preview.interface is not None and preview.lights else [*sliders, agx]

    def draw(_: Any = None) -> None:
        preview.rotate_to(light.value)
        preview.set_exposure(exposure.value)
        if reflection.value != preview.reflecting:
            preview.toggle_reflection()
        preview.tone_map = "agx" if agx.value else "none"
        view.reset_camera()
        view.plotter.camera.Azimuth(around.value)
        view.plotter.camera.Elevation(above.value - height)
        view.settle()
        encoded = io.BytesIO()
        Image.fromarray(view.picture()).save(encoded, format="PNG", compress_level=1)
        picture.value = encoded.getvalue()

    for control in shown:
        control.observe(draw, "value")
    draw()
    return ipywidgets.VBox([picture, ipywidgets.HBox(shown, layout={"flex_flow": "row wrap"})])


def _slider(name: str, value: float, most: float, step: float) -> Any:
    return ipywidgets.FloatSlider(value, min=-most, max=most, step=step, description=name)
