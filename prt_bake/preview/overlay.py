"""Texts over the picture: keys, status, message and the scale of false colours."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util import numpy_support
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkRenderingCore import vtkActor2D, vtkCoordinate, vtkPolyDataMapper2D, vtkTextActor

from prt_bake.preview import colours
from prt_bake.preview.state import Scale

numpy_to_vtk: Any = numpy_support.numpy_to_vtk
_INK, _PAPER = (0.96, 0.96, 0.96), (0.05, 0.05, 0.06)
SLIDERS = (0.56, 0.75), (0.78, 0.97)
"""Left and right ends of the sliders, relative to the window."""
_STEPS = 64
_BAR = (0.05, 0.45, 0.065, 0.085)
"""Left, right, lower and upper edge of the scale, relative to the window."""


class Overlay:
    """Texts over a renderer; empty ones are hidden."""

    def __init__(self, renderer: Any, width: int) -> None:
        """width: of the window in pixels; it sets the font size."""
        letters = min(max(round(width / 50), 9), 14)
        self.status = _text(renderer, (0.015, 0.98), letters, top=True)
        self.message = _text(renderer, (0.015, 0.93), letters, top=True)
        self.legend = _text(renderer, (0.015, 0.87), letters, top=True, fixed_width=True)
        self.rotation, self.exposure = (_text(renderer, (left, 0.02), letters) for left, _ in SLIDERS)
        left, right, low, high = _BAR
        self._bar = _Bar(renderer)
        self._low, self._high = (
            _text(renderer, (x, low - 0.01), letters, top=True, centred=True) for x in (left, right)
        )
        self._label = _text(renderer, (0.5 * (left + right), high + 0.01), letters, centred=True)
        scale_texts = (self._low, self._high, self._label)
        texts = (self.legend, self.status, self.message, self.rotation, self.exposure, *scale_texts)
        self._parts = (*texts, self._bar.actor)

    def write(self, actor: Any, text: str) -> None:
        """Set the text of one of the actors."""
        actor.SetInput(text)
        actor.SetVisibility(bool(text))

    def show_scale(self, scale: Scale | None) -> None:
        """Show the scale of the false colours, or none."""
        self._bar.actor.SetVisibility(scale is not None)
        form = "{:.2%}" if scale is not None and scale.low == 0.0 else "{:.2g}"
        self.write(self._low, "" if scale is None else form.format(scale.low))
        self.write(self._high, "" if scale is None else form.format(scale.high))
        self.write(self._label, "" if scale is None else scale.label)
        if scale is not None:
            steps = np.linspace(scale.low, scale.high, _STEPS) / scale.high
            self._bar.paint(colours.about_zero(steps) if scale.low < 0.0 else colours.from_zero(steps))

    def hide(self) -> list[Any]:
        """Hide all texts; return those that were visible, for `restore`."""
        visible = [part for part in self._parts if part.GetVisibility()]
        for part in visible:
            part.VisibilityOff()
        return visible

    def restore(self, visible: list[Any]) -> None:
        """Show the parts that `hide` returned."""
        for part in visible:
            part.VisibilityOn()


def _text(
    renderer: Any,
    position: tuple[float, float],
    letters: int,
    top: bool = False,
    centred: bool = False,
    fixed_width: bool = False,
) -> Any:
    text = vtkTextActor()
    text.GetPositionCoordinate().SetCoordinateSystemToNormalizedViewport()
    text.SetPosition(*position)
    _set_font(text.GetTextProperty(), letters, fixed_width)
    if top:
        text.GetTextProperty().SetVerticalJustificationToTop()
    if centred:
        text.GetTextProperty().SetJustificationToCentered()
    text.VisibilityOff()
    renderer.AddViewProp(text)
    return text


class _Bar:
    """The colour bar of the scale."""

    def __init__(self, renderer: Any) -> None:
        left, right, low, high = _BAR
        x, y = np.meshgrid(np.linspace(left, right, _STEPS), [low, high])
        corners = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        first = np.arange(_STEPS - 1)
        quads = np.stack([first, first + 1, first + 1 + _STEPS, first + _STEPS], axis=1)
        points, cells, self._strip = vtkPoints(), vtkCellArray(), vtkPolyData()
        points.SetData(numpy_to_vtk(corners, deep=True))
        for quad in quads.tolist():
            cells.InsertNextCell(4, quad)
        self._strip.SetPoints(points)
        self._strip.SetPolys(cells)
        mapper, coordinate = vtkPolyDataMapper2D(), vtkCoordinate()
        coordinate.SetCoordinateSystemToNormalizedViewport()
        mapper.SetTransformCoordinate(coordinate)
        mapper.SetInputData(self._strip)
        self.actor = vtkActor2D()
        self.actor.SetMapper(mapper)
        self.actor.VisibilityOff()
        renderer.AddViewProp(self.actor)

    def paint(self, colours: NDArray[np.float64]) -> None:
        """Set the colours, sRGB [steps,3], from left to right."""
        srgb = np.rint(255.0 * np.concatenate([colours, colours])).astype(np.uint8)
        self._strip.GetPointData().SetScalars(numpy_to_vtk(srgb, deep=True))


def _set_font(style: Any, size: int, fixed_width: bool) -> None:
    if fixed_width:
        style.SetFontFamilyToCourier()
    else:
        style.SetFontFamilyToArial()
    style.SetFontSize(size)
    style.SetColor(*_INK)
    style.SetBackgroundColor(*_PAPER)
    style.SetBackgroundOpacity(0.7)
    style.SetLineSpacing(1.15)
