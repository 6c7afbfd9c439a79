"""The Python API of prtbake: `import prt_bake as prt`.

`train` path traces a translucent object and fits a network to it, `bake` projects its transport on real spherical
harmonics at every vertex and view bin, and `shade` relights it by dot products. Names are imported on first use, so
that reading and shading an asset never loads torch.

>>> import prt_bake as prt
>>> prt.project_environment([[[1.0, 1.0, 1.0]] * 4] * 2, degree=0).round(4).tolist()
[[3.5449, 3.5449, 3.5449]]
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from formats.asset import Asset, read_asset, write_asset
    from formats.errors import (
        AssetError,
        ClusterError,
        FormatError,
        ImageError,
        InputWarning,
        LightError,
        MeshError,
        ModelError,
        PrtbakeError,
        QueryError,
        SamplesError,
        SceneError,
        StorageError,
    )
    from formats.image import read_image, read_layers, srgb, write_image
    from formats.mesh import Mesh, read_mesh, write_mesh
    from formats.scene import Scene
    from formats.scene import read_scene as load_scene
    from prt_bake.baking.bake import bake
    from prt_bake.baking.compress import compress, unpacked
    from prt_bake.baking.lobes.addition import add_lobes
    from prt_bake.comparison.metrics import compare
    from prt_bake.export.exr import export_exr
    from prt_bake.export.gltf import export_gltf
    from prt_bake.export.mitsuba import mitsuba_dictionary
    from prt_bake.geometry.camera import Camera
    from prt_bake.geometry.camera import fit as fit_camera
    from prt_bake.lights.environment import project as project_environment
    from prt_bake.lights.environment import read_environment, rotate_light
    from prt_bake.lights.lighting import Lighting, read_lighting
    from prt_bake.mathematics import sh, sphere
    from prt_bake.network.bssrdf import NeuralBSSRDF, load_model, save_model
    from prt_bake.rendering.network import render_network
    from prt_bake.rendering.scene import render_scene
    from prt_bake.shading.asset_light import light_for
    from prt_bake.shading.frames.frames import Frames
    from prt_bake.shading.picture import render_picture, shade
    from prt_bake.shading.sun_shading import suns_apart
    from prt_bake.shipped.examples import example
    from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
    from prt_bake.trainer.train import train

__all__ = [
    "Asset",
    "AssetError",
    "Camera",
    "ClusterError",
    "FormatError",
    "Frames",
    "ImageError",
    "InputWarning",
    "LightError",
    "Lighting",
    "Mesh",
    "MeshError",
    "ModelError",
    "NeuralBSSRDF",
    "PrtbakeError",
    "QueryError",
    "SamplesError",
    "Scene",
    "SceneError",
    "StorageError",
    "add_lobes",
    "bake",
    "compare",
    "compress",
    "estimate_coefficients",
    "estimate_transport",
    "example",
    "export_exr",
    "export_gltf",
    "fit_camera",
    "light_for",
    "load_model",
    "load_scene",
    "mitsuba_dictionary",
    "project_environment",
    "read_asset",
    "read_environment",
    "read_image",
    "read_layers",
    "read_lighting",
    "read_mesh",
    "render_network",
    "render_picture",
    "render_scene",
    "rotate_light",
    "save_model",
    "sh",
    "shade",
    "sphere",
    "srgb",
    "suns_apart",
    "train",
    "unpacked",
    "write_asset",
    "write_image",
    "write_mesh",
]

__version__: str

# Public name → (module, name in it); an empty name is the module itself.
_ORIGIN = {
    "Asset": ("formats.asset", "Asset"),
    "AssetError": ("formats.errors", "AssetError"),
    "Camera": ("prt_bake.geometry.camera", "Camera"),
    "ClusterError": ("formats.errors", "ClusterError"),
    "FormatError": ("formats.errors", "FormatError"),
    "Frames": ("prt_bake.shading.frames.frames", "Frames"),
    "ImageError": ("formats.errors", "ImageError"),
    "InputWarning": ("formats.errors", "InputWarning"),
    "LightError": ("formats.errors", "LightError"),
    "Lighting": ("prt_bake.lights.lighting", "Lighting"),
    "Mesh": ("formats.mesh", "Mesh"),
    "MeshError": ("formats.errors", "MeshError"),
    "ModelError": ("formats.errors", "ModelError"),
    "NeuralBSSRDF": ("prt_bake.network.bssrdf", "NeuralBSSRDF"),
    "PrtbakeError": ("formats.errors", "PrtbakeError"),
    "QueryError": ("formats.errors", "QueryError"),
    "SamplesError": ("formats.errors", "SamplesError"),
    "Scene": ("formats.scene", "Scene"),
    "SceneError": ("formats.errors", "SceneError"),
    "StorageError": ("formats.errors", "StorageError"),
    "add_lobes": ("prt_bake.baking.lobes.addition", "add_lobes"),
    "bake": ("prt_bake.baking.bake", "bake"),
    "compare": ("prt_bake.comparison.metrics", "compare"),
    "compress": ("prt_bake.baking.compress", "compress"),
    "estimate_coefficients": ("prt_bake.tracer.estimate", "estimate_coefficients"),
    "estimate_transport": ("prt_bake.tracer.estimate", "estimate_transport"),
    "example": ("prt_bake.shipped.examples", "example"),
    "export_exr": ("prt_bake.export.exr", "export_exr"),
    "export_gltf": ("prt_bake.export.gltf", "export_gltf"),
    "fit_camera": ("prt_bake.geometry.camera", "fit"),
    "light_for": ("prt_bake.shading.asset_light", "light_for"),
    "load_model": ("prt_bake.network.bssrdf", "load_model"),
    "load_scene": ("formats.scene", "read_scene"),
    "mitsuba_dictionary": ("prt_bake.export.mitsuba", "mitsuba_dictionary"),
    "project_environment": ("prt_bake.lights.environment", "project"),
    "read_asset": ("formats.asset", "read_asset"),
    "read_environment": ("prt_bake.lights.environment", "read_environment"),
    "read_image": ("formats.image", "read_image"),
    "read_layers": ("formats.image", "read_layers"),
    "read_lighting": ("prt_bake.lights.lighting", "read_lighting"),
    "read_mesh": ("formats.mesh", "read_mesh"),
    "render_network": ("prt_bake.rendering.network", "render_network"),
    "render_picture": ("prt_bake.shading.picture", "render_picture"),
    "render_scene": ("prt_bake.rendering.scene", "render_scene"),
    "rotate_light": ("prt_bake.lights.environment", "rotate_light"),
    "save_model": ("prt_bake.network.bssrdf", "save_model"),
    "sh": ("prt_bake.mathematics.sh", ""),
    "shade": ("prt_bake.shading.picture", "shade"),
    "sphere": ("prt_bake.mathematics.sphere", ""),
    "srgb": ("formats.image", "srgb"),
    "suns_apart": ("prt_bake.shading.sun_shading", "suns_apart"),
    "train": ("prt_bake.trainer.train", "train"),
    "unpacked": ("prt_bake.baking.compress", "unpacked"),
    "write_asset": ("formats.asset", "write_asset"),
    "write_image": ("formats.image", "write_image"),
    "write_mesh": ("formats.mesh", "write_mesh"),
}


def __getattr__(name: str) -> object:
    """Import a public name on first use and store it, so that later look-ups are ordinary ones."""
    if name == "__version__":
        from formats.version import program_version

        return program_version()
    if name not in _ORIGIN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from prt_bake.face.public import public

    module_name, attribute = _ORIGIN[name]
    module = import_module(module_name)
    value: object = public(name, getattr(module, attribute) if attribute else module)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
