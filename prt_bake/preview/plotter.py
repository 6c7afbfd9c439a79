"""The PyVista plotter of the preview: a window on the display, or a picture in memory."""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def watching_for_destruction(plotter: pv.Plotter) -> Iterator[Callable[[], bool]]:
    """Context in which a function returns whether the plotter's X window was destroyed from outside.

    VTK does not notice that, and Xlib ends the process at the next request for such a window. Without X the function
    returns False.
    """
    window: Any = plotter.render_window
    if not window.IsA("vtkXOpenGLRenderWindow"):
        yield lambda: False
        return
    errors: list[int] = []

    def record(_display: int, event: int) -> int:
        errors.append(event)
        return 0

    def destroyed() -> bool:
        window.GetPosition()  # a request that fails then
        return bool(errors)

    handler = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    xlib = ctypes.CDLL("libX11.so.6")
    xlib.XSetErrorHandler.restype = ctypes.c_void_p
    xlib.XSetErrorHandler.argtypes = [ctypes.c_void_p]
    recorder = handler(record)
    before = xlib.XSetErrorHandler(ctypes.cast(recorder, ctypes.c_void_p))
    try:
        yield destroyed
    finally:
        xlib.XSetErrorHandler(before)
