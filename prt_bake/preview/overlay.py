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
_SCALE = 17
"""Width of the scale, in letters."""
_LEGEND_TOP = 0.87
_ROW = 1.25
"""Height of a row of the legend, relative to its letters."""


class Overlay:
    """Texts over a plotter; empty ones are hidden.

    Attributes:
        status, message, legend, rotation, exposure: the texts.
    """

    def __init__(self, plotter: pv.Plotter) -> None:
        self._plotter = plotter
        self._letters = _letters(plotter.window_size[0])
        self._scale: Scale | None = None
        self.status = self._text(0.015, 0.98)
        self.message = self._text(0.015, 0.93)
        self.legend = self._text(0.015, _LEGEND_TOP, font="courier")
        self.rotation, self.exposure = (self._text(left, 0.02, "bottom") for left, _ in SLIDERS)
        self._texts = (self.status, self.message, self.legend, self.rotation, self.exposure)

    def fit(self, width: int) -> None:
        """Fit the letters to the width of the window in pixels."""
        if self._letters != _letters(width):
            self._letters = _letters(width)
            for text in self._texts:
                text.prop.font_size = self._letters
            self.show_scale(self._scale)

    @property
    def legend_bottom(self) -> float:
        """The lower end of the legend, relative to the window; its upper end while it is empty."""
        rows = self.legend.input.count("\n") + bool(self.legend.input)
        return float(_LEGEND_TOP - rows * _ROW * self._letters / self._plotter.window_size[1])

    def write(self, text: pv.Text, content: str) -> None:
        """Set the content of one of the texts."""
        text.input = content
        text.SetVisibility(bool(content))

    def show_scale(self, scale: Scale | None) -> None:
        """Show the scale of the false colours, or none."""
        self._scale = scale
        for title in list(self._plotter.scalar_bars.keys()):
            self._plotter.remove_scalar_bar(title, render=False)
        if scale is None:
            return
        steps = np.linspace(scale.low, scale.high, _STEPS) / scale.high
        ramp = colours.about_zero(steps) if scale.low < 0.0 else colours.from_zero(steps)
        form = "{:.2%}" if scale.low == 0.0 else "{:.2g}"
        self._plotter.add_scalar_bar(
            f"{scale.label}: {form.format(scale.low)} to {form.format(scale.high)}",
            lookup_table=pv.LookupTable(values=np.rint(255.0 * np.insert(ramp, 3, 1.0, axis=1)).astype(np.uint8)),
            n_labels=0,
            title_font_size=self._letters,
            vertical=False,
            position_x=0.015,
            position_y=0.02,
            width=_SCALE * self._letters / self._plotter.window_size[0],
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


def _letters(width: int) -> int:
    """Return the height of letters in a window of this width, in pixels."""
    return min(max(round(width / 50), 9), 14)
