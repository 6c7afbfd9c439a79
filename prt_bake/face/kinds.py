"""The kind of each argument of a public function, by its name. A check returns the value in the type to work with."""

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from formats import arguments
from formats.errors import QueryError, refuse_path
from formats.mesh import as_mesh
from prt_bake.face.assets import asset, light_of_vertices

Check = Callable[[str, Any], Any]


def scene(name: str, value: Any) -> Any:
    """A scene."""
    arguments.require(name, value, ("parts", "medium", "mesh"), "prt.load_scene")
    return value


def lighting(name: str, value: Any) -> Any:
    """Skies and suns."""
    if hasattr(value, "shape"):
        raise QueryError(
            f"{name}: expected what prt.read_lighting(path) returns, found {arguments.described(value)}; its "
            f"coefficients are prt.project_environment(image)"
        )
    arguments.require(name, value, ("skies", "suns"), "prt.read_lighting")
    return value


def light_of_picture(name: str, value: Any) -> Any:
    """A lighting, or the picture of a sky."""
    if hasattr(value, "skies"):
        return value
    if isinstance(value, str) or hasattr(value, "__fspath__"):
        return lighting(name, value)
    return arguments.radiance(name, value)


def camera(name: str, value: Any) -> Any:
    """A camera."""
    if not all(hasattr(value, each) for each in ("eye", "target", "fov", "width")):
        found = arguments.described(value)
        raise QueryError(f"{name}: expected what prt.fit_camera(mesh, width, height, eye=…) returns, found {found}")
    return value


def point(name: str, value: Any) -> Any:
    """A point, or directions to it."""
    if isinstance(value, str):
        raise QueryError(f"{name}: expected numbers such as [0, 1, 4], found {arguments.described(value)}")
    array = arguments.numbers(name, value)
    if array.shape == (3,) and not np.isfinite(array).all():
        raise QueryError(f"{name}: expected three finite numbers, found {array.tolist()}")
    return array


def model(name: str, value: Any) -> Any:
    """A neural BSSRDF."""
    arguments.require(name, value, ("evaluate", "settings", "metadata"), "prt.load_model")
    return value


def transport(name: str, value: Any) -> Any:
    """An object that evaluates Ŝ or estimates its coefficients."""
    if hasattr(value, "evaluate") or hasattr(value, "evaluate_block") or hasattr(value, "estimate_coefficients"):
        return value
    refuse_path(name, value, "prt.load_model")
    raise QueryError(
        f"{name}: expected what prt.load_model(path) returns, or an object with evaluate(incident, positions, "
        f"outgoing), found {arguments.described(value)}"
    )


def baked(name: str, value: Any) -> Any:
    """What can be baked: a transport, or a scene, which is path traced."""
    return value if arguments.described(value) == "a scene" else transport(name, value)


def device(name: str, value: Any) -> str:
    """A device that exists here: "cpu", "cuda" or "cuda:0"."""
    text = str(value) if type(value).__module__ == "torch" else value
    if text == "cpu":
        return "cpu"
    if isinstance(text, str) and text.split(":")[0] == "cuda":
        import torch

        if torch.cuda.is_available():
            return text
    raise QueryError(
        f"{name}: expected 'cpu', or 'cuda' with a GPU that the installed torch can use, found {value!r}; give 'cpu'"
    )


def device_or_auto(name: str, value: Any) -> str:
    """A device, or "auto": CUDA where it exists."""
    return "auto" if isinstance(value, str) and value == "auto" else device(name, value)


def function(name: str, value: Any) -> Any:
    """A function to call."""
    if not callable(value):
        raise QueryError(f"{name}: expected a function, found {arguments.described(value)}")
    return value


def angle(name: str, value: Any) -> float:
    """Finite degrees."""
    degrees = arguments.real_number(name, value)
    if not math.isfinite(degrees):
        raise QueryError(f"{name}: expected a finite number of degrees, found {degrees}")
    return degrees


def collection(name: str, value: Any) -> Any:
    """Several names; a single one is refused where they are read."""
    if not isinstance(value, Collection):
        raise QueryError(f"{name}: expected a collection of names, found {arguments.described(value)}")
    return value


def dictionary(name: str, value: Any) -> Any:
    """Entries by name."""
    if not isinstance(value, Mapping):
        raise QueryError(f"{name}: expected a dictionary, found {arguments.described(value)}")
    return value


def lights(name: str, value: Any) -> Any:
    """Files of skies and lights, or suns as text, one or several."""
    each = [value] if isinstance(value, str) or not hasattr(value, "__iter__") else list(value)
    return value if not [arguments.path(name, one) for one in each] else each


def coefficients(name: str, value: Any) -> Any:
    """Coefficients [K,3] of a light, or a record of them."""
    if hasattr(value, "coefficients"):
        return value
    array = None if isinstance(value, str) or hasattr(value, "skies") else arguments.numbers(name, value)
    if array is None or array.ndim != 2 or array.shape[1] != 3:
        raise QueryError(
            f"{name}: expected coefficients of shape [K, 3], as prt.project_environment(image) returns, found "
            f"{arguments.described(value if array is None else array)}"
        )
    return array


def seed(name: str, value: Any) -> int:
    """A key of random numbers."""
    number = arguments.whole_number(name, value)
    if number < 0:
        raise QueryError(f"{name} must be at least 0, found {number}")
    return number


def mask(name: str, value: Any) -> Any:
    """A mask, of booleans or of weights."""
    return value if getattr(value, "dtype", None) == np.bool_ else arguments.numbers(name, value)


WHOLE = arguments.whole_number

KINDS: dict[str, Check] = {
    "asset": asset,
    "mesh": as_mesh,
    "scene": scene,
    "transport": transport,
    "lighting": lighting,
    "lights": lights,
    "camera": camera,
    "seed": seed,
    "mask": mask,
    "device": device,
    "leave_out": collection,
    "provenance": dictionary,
    **dict.fromkeys(("coefficients", "for_light"), coefficients),
    **dict.fromkeys(("image", "reference"), arguments.radiance),
    **dict.fromkeys(("eye", "target", "for_eye"), point),
    **dict.fromkeys(("alpha", "positions", "outgoing", "incident", "origin"), arguments.numbers),
    **dict.fromkeys(("degree", "rings", "sectors", "workers", "lobes", "most", "paths"), WHOLE),
    **dict.fromkeys(("samples", "steps", "spp", "width", "height", "connections"), WHOLE),
    **dict.fromkeys(("error", "minutes", "exposure", "fov", "extent", "scale", "every"), arguments.real_number),
    **dict.fromkeys(("degrees", "rotate"), angle),
    **dict.fromkeys(("path", "out", "output", "folder", "checkpoint"), arguments.path),
    **dict.fromkeys(("progress", "stop", "say", "preview"), function),
}
"""The check of each name of an argument."""

OF_FUNCTION: dict[tuple[str, str], Check] = {
    ("shade", "light"): light_of_vertices,
    ("render_picture", "light"): light_of_picture,
    ("render_scene", "light"): light_of_picture,
    ("render_network", "light"): light_of_picture,
    ("render_network", "network"): transport,
    ("save_model", "network"): model,
    ("bake", "transport"): baked,
    ("train", "samples"): arguments.path,
    ("train", "device"): device_or_auto,
}
"""Arguments whose name has another meaning in one function."""
