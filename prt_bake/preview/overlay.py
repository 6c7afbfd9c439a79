"""Texts over the picture: keys, status, message and the scale of false colours."""

from typing import Any

import numpy as np
import pyvista as pv

from prt_bake.preview import colours
from prt_bake.preview.state import Scale

_INK, _PAPER = "whitesmoke", "black"
SLIDERS = (0.56, 0.75), (0.78, 0.97)
"""Left and right ends of the sliders, relative to the window."""
_STEPS = 64


class Overlay:
    """Texts over a plotter; empty ones are hidden.

    Attributes:
        status, message, legend, rotation, exposure: the texts.
    """

    def __init__(self, plotter: pv.Plotter) -> None:
        self._plotter = plotter
        self._letters = min(max(round(plotter.window_size[0] / 50), 9), 14)
        self.status = self._text(0.015, 0.98)
        self.message = self._text(0.015, 0.93)
        self.legend = self._text(0.015, 0.87, font="courier")
        self.rotation, self.exposure = (self._text(left, 0.02, "bottom") for left, _ in SLIDERS)
        self._texts = (self.status, self.message, self.legend, self.rotation, self.exposure)

    def write(self, text: pv.Text, content: str) -> None:
        """Set the content of one of the texts."""
        text.input = content
        text.SetVisibility(bool(content))

    def show_scale(self, scale: Scale | None) -> None:
        """Show the scale of the false colours, or none."""
        for title in list(self._plotter.scalar_bars.keys()):
            self._plotter.remove_scalar_bar(title, render=False)
        if scale is None:
            return
        steps = np.linspace(scale.low, scale.high, _STEPS) / scale.high
        ramp = colours.about_zero(steps) if scale.low < 0.0 else colours.from_zero(steps)
        form = "{:.2%}" if scale.low == 0.0 else "{:.2g}"
        self._plotter.add_scalar_bar(
            f"{scale.label}, {form.format(scale.low)} to {form.format(scale.high)}",
            lookup_table=pv.LookupTable(values=np.rint(255.0 * np.insert(ramp, 3, 1.0, axis=1)).astype(np.uint8)),
            n_labels=0,
            title_font_size=self._letters,
            vertical=False,
            position_x=0.05,
            position_y=0.02,
            width=0.45,
            height=0.07,
            color=_INK,
            background_color=_PAPER,
            fill=True,
        )

    def hide(self) -> list[Any]:
        """Hide all texts; return those that were visible, for `restore`."""
        parts = [*self._texts, *self._plotter.scalar_bars.values()]
        visible = [part for part in parts if part.GetVisibility()]
        for part in visible:
            part.VisibilityOff()
        return visible

    def restore(self, visible: list[Any]) -> None:
        """Show the parts that `hide` returned."""
        for part in visible:
            part.VisibilityOn()

    def _text(self, x: float, y: float, anchor: str = "top", font: str = "arial") -> Any:
        text: Any = self._plotter.add_text(
            "", position=(x, y), font_size=self._letters / 2, color=_INK, font=font, viewport=True, render=False
        )
        text.prop.background_color = _PAPER
        text.prop.background_opacity = 0.7
        text.prop.justification_vertical = anchor
        text.SetVisibility(False)
        return text
