"""The PyVista plotter of the preview: a window on the display, or a picture in memory."""

from typing import Any

import pyvista as pv

_BACKGROUND = (0.13, 0.13, 0.14)
"""Background without a sky, sRGB."""
_IN_MEMORY = ("vtkEGL", "vtkOSOpenGL")
"""Classes of windows that VTK makes where there is no display."""


def open_plotter(width: int, height: int, off_screen: bool | None = None, title: str = "prtbake") -> pv.Plotter:
    """Return an empty plotter of this size without lights; `off_screen` as in `pyvista.Plotter`."""
    pv.vtk_verbosity("error")  # VTK warns if there is no display; our callers report that themselves
    plotter = pv.Plotter(off_screen=off_screen, window_size=[width, height], lighting="none", title=title)
    plotter.set_background(_BACKGROUND)
    renderer: Any = plotter.renderer
    # VTK's culler sorts by distance. The object is drawn first, so that the depth test skips the sky behind it.
    renderer.RemoveCuller(renderer.GetCullers().GetLastItem())
    return plotter


def on_display(plotter: pv.Plotter) -> bool:
    """Whether the plotter's window is visible; without a display VTK makes one in memory."""
    return not plotter.render_window.GetClassName().startswith(_IN_MEMORY)
