"""An asset as a mesh for PyVista, with the radiance of a light."""

import os
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from formats.arguments import numbers, radiance
from formats.asset import Asset
from formats.errors import warn
from formats.image.png import to_srgb
from formats.mesh.polydata import polydata
from prt_bake.face.assets import asset as require_asset
from prt_bake.face.assets import light_of_vertices, point
from prt_bake.geometry import camera
from prt_bake.lights.lighting import Lighting, as_lighting, read_lighting
from prt_bake.shading.asset_light import AssetLight, light_for
from prt_bake.shading.vertices import shade

if TYPE_CHECKING:
    import pyvista

Light = str | os.PathLike[str] | Lighting | AssetLight | ArrayLike | None


def to_pyvista(asset: Asset, light: Light = None, eye: ArrayLike | None = None) -> "pyvista.PolyData":
    """Return the asset's mesh with its radiance; `Asset.to_pyvista` describes it."""
    require_asset("asset", asset)
    mesh = polydata(asset.mesh.positions, asset.mesh.faces, asset.mesh.normals)
    where = camera.fit(asset.mesh, up=asset.up).eye if eye is None else point("eye", eye)
    values = shade(asset, _prepared(asset, light), where)
    mesh.point_data["radiance"] = values.astype(np.float32)
    mesh.point_data["rgb"] = np.rint(255.0 * to_srgb(values)).astype(np.uint8)
    mesh.set_active_scalars("rgb")
    return mesh


def shipped_sky() -> str:
    """Return the path of the shipped sky."""
    return str(resources.files("prt_bake.shipped") / "sky.hdr")


def _prepared(asset: Asset, light: Light) -> Any:
    """Return the light as `shade` takes it."""
    if asset.quantity == "radiance" or isinstance(light, AssetLight):
        return light
    if light is None or isinstance(light, str | os.PathLike):
        path = shipped_sky() if light is None else os.fspath(light)
        light = read_lighting([path], asset.up, say=warn, mesh=asset.mesh)
    if isinstance(light, Lighting):
        return light_for(asset, light)
    if isinstance(light, list | tuple):
        light = numbers("light", light)
    if getattr(light, "ndim", 2) == 3 or type(light).__module__.startswith("PIL."):
        return light_for(asset, as_lighting(radiance("light", light), asset.up, 0.0))
    return light_of_vertices("light", light)
