"""The plotter's window on a display, which Xvfb gives where it is installed."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator

import pytest

from prt_bake.preview.plotter import open_plotter, watching_for_destruction

DESTROY = """
import ctypes
from prt_bake.preview.plotter import on_display, open_plotter, watching_for_destruction

plotter = open_plotter(60, 40)
plotter.show(auto_close=False, interactive=False)
if not on_display(plotter):  # Xvfb without OpenGL
    raise SystemExit(77)
xlib = ctypes.CDLL("libX11.so.6")
xlib.XOpenDisplay.restype = ctypes.c_void_p
other = ctypes.c_void_p(xlib.XOpenDisplay(None))
window = int(plotter.render_window.GetGenericWindowId().split("_")[1], 16)
with watching_for_destruction(plotter) as destroyed:
    assert not destroyed()
    xlib.XDestroyWindow(other, ctypes.c_ulong(window))
    xlib.XSync(other, 0)
    assert destroyed()
    plotter.close()
"""


@pytest.fixture
def display() -> Iterator[str]:
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed")
    with subprocess.Popen(["Xvfb", "-displayfd", "1"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().decode().strip()}"
        server.terminate()


def test_a_window_that_is_destroyed_from_outside_is_noticed(display: str) -> None:
    run = [sys.executable, "-c", DESTROY]
    ran = subprocess.run(run, env={**os.environ, "DISPLAY": display}, capture_output=True, text=True, check=False)
    if ran.returncode == 77:
        pytest.skip("the display has no OpenGL")
    assert ran.returncode == 0, ran.stderr


def test_a_window_in_memory_is_never_destroyed() -> None:
    plotter = open_plotter(60, 40, True)
    with watching_for_destruction(plotter) as destroyed:
        assert not destroyed()
    plotter.close()
