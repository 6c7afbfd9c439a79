"""The plotter's window: its destruction from outside is noticed."""

import ctypes
from types import SimpleNamespace
from typing import Any

import pytest

from prt_bake.preview.plotter import open_plotter, watching_for_destruction

HANDLER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)


class SetErrorHandler:
    """XSetErrorHandler: takes the function that Xlib calls when a request fails, and returns the one before."""

    restype: Any = None
    argtypes: Any = None
    current: Any = "that of Xlib"

    def __call__(self, handler: Any) -> Any:
        before, self.current = self.current, handler
        return before


def test_a_window_that_is_destroyed_from_outside_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    xlib = SimpleNamespace(XSetErrorHandler=SetErrorHandler())
    monkeypatch.setattr(ctypes, "CDLL", lambda _name: xlib)
    there = [True]

    def request() -> None:
        if not there[0]:
            ctypes.cast(xlib.XSetErrorHandler.current, HANDLER)(None, None)

    window = SimpleNamespace(IsA=lambda name: name == "vtkXOpenGLRenderWindow", GetPosition=request)
    with watching_for_destruction(SimpleNamespace(render_window=window)) as destroyed:  # type: ignore[arg-type]
        assert not destroyed()
        there[0] = False
        assert destroyed()
    assert xlib.XSetErrorHandler.current == "that of Xlib"


def test_a_window_in_memory_is_never_destroyed() -> None:
    plotter = open_plotter(60, 40, True)
    with watching_for_destruction(plotter) as destroyed:
        assert not destroyed()
    plotter.close()
