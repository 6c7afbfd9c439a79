"""`Asset.show`: the preview window from Python, and in a notebook."""

import importlib.util
import os
from typing import Any

from numpy.typing import ArrayLike

from formats.arguments import described
from formats.asset import Asset
from formats.errors import QueryError, warn
from formats.extras import require
from prt_bake.face.assets import asset as require_asset
from prt_bake.face.assets import point
from prt_bake.geometry import camera
from prt_bake.lights.lighting import Lighting, warn_of_other_up
from prt_bake.preview.lights import LightSource
from prt_bake.preview.polydata import shipped_sky
from prt_bake.preview.state import Preview

_SIZE = 800, 600


def show(asset: Asset, light: str | os.PathLike[str] | Lighting | None = None, eye: ArrayLike | None = None) -> Any:
    """Show the window, or draw it in a notebook; `Asset.show` describes it."""
    require_asset("asset", asset)
    require("show", "pyvista")
    from prt_bake.preview.window import View, Window, on_display, open_plotter

    preview = Preview(asset, _sources(asset, light))
    start = camera.fit(asset.mesh, *_SIZE, eye=None if eye is None else point("eye", eye), up=asset.up)
    camera.refuse_eye_in_object(asset.mesh, start.eye)
    plotter = open_plotter(*_SIZE)
    if not plotter.notebook and not on_display(plotter):
        plotter.close()
        raise QueryError(
            "show: there is no display for the window; asset.to_pyvista() draws with any plotter, such as "
            "pyvista.Plotter(off_screen=True)"
        )
    view = View(preview, plotter, start)
    if plotter.notebook:
        return _controls(view)
    Window(view, "asset").run()
    return None


def _sources(asset: Asset, light: str | os.PathLike[str] | Lighting | None) -> list[LightSource]:
    if light is None and asset.quantity == "radiance":
        return []
    known = shipped_sky() if light is None else light
    if not isinstance(known, str | os.PathLike | Lighting):
        raise QueryError(
            f"light: expected the path of a light, or what prt.read_lighting returns, found {described(light)}"
        )
    if asset.quantity == "radiance":
        raise QueryError("light: the asset was made for one light and cannot be relit; pass None to show it")
    if isinstance(known, Lighting):
        warn_of_other_up(known, asset.up)
    text = known if isinstance(known, Lighting) else os.fspath(known)
    return [LightSource(text, asset.up, asset.degree, say=warn, mesh=asset.mesh)]


def _controls(view: Any) -> Any:
    """Return the sliders and their picture, or the picture alone if ipywidgets is not installed."""
    view.preview.load()
    view.plotter.show(auto_close=False, jupyter_backend="none")
    if importlib.util.find_spec("ipywidgets") is None:
        from PIL import Image

        view.settle()
        return Image.fromarray(view.picture())
    from prt_bake.preview.notebook import controls

    return controls(view)
