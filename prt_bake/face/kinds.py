"""The kind of each argument of a public function, by its name. A check returns the value in the type to work with."""

import json
import math
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from formats import arguments
from formats.errors import QueryError, refuse_path
from formats.mesh import as_mesh
from prt_bake.face.assets import asset, light_of_vertices, point

Check = Callable[[str, Any], Any]
_COVERAGE_ROUNDING = 1e-3


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
    if hasattr(value, "skies") and not isinstance(value, type):
        return value
    if isinstance(value, str) or hasattr(value, "__fspath__"):
        return lighting(name, value)
    if hasattr(value, "harmonics") or (isinstance(value, list | tuple) and hasattr(next(iter(value), None), "skies")):
        raise QueryError(
            f"{name}: expected what prt.read_lighting(path) returns, or a lat-long picture [H, W, 3], found "
            f"{arguments.described(value)}; prt.read_lighting([...]) reads several lights together"
        )
    return arguments.radiance(name, value)


def visible(name: str, value: Any) -> Any:
    """Linear radiance that can be shown."""
    array = arguments.radiance(name, value)
    if unknown := int(np.isnan(array).sum()):
        raise QueryError(f"{name}: expected numbers, found {unknown} that are NaN")
    return array


def camera(name: str, value: Any) -> Any:
    """A camera."""
    if not all(hasattr(value, each) for each in ("eye", "target", "fov", "width")):
        found = arguments.described(value)
        raise QueryError(f"{name}: expected what prt.fit_camera(mesh, width, height, eye=…) returns, found {found}")
    return value


def model(name: str, value: Any) -> Any:
    """A neural BSSRDF."""
    arguments.require(name, value, ("evaluate", "settings", "metadata"), "prt.load_model")
    return value


def transport(name: str, value: Any) -> Any:
    """An object that evaluates Ŝ or estimates its coefficients, or a function that evaluates Ŝ."""
    if isinstance(value, type):
        raise QueryError(f"{name}: expected an object, found the class {value.__name__}; give {value.__name__}(…)")
    if hasattr(value, "evaluate") or hasattr(value, "evaluate_block") or hasattr(value, "estimate_coefficients"):
        return value
    refuse_path(name, value, "prt.load_model")
    if callable(value):
        return value
    raise QueryError(
        f"{name}: expected what prt.load_model(path) returns, an object with evaluate(incident, positions, outgoing), "
        f"or a function of these, found {arguments.described(value)}"
    )


def baked(name: str, value: Any) -> Any:
    """What can be baked: a transport, or a scene, which is path traced."""
    return value if arguments.described(value) == "a scene" else transport(name, value)


def device_name(name: str, value: Any) -> str:
    """The name of a device, of torch too."""
    return text(name, str(value) if type(value).__module__ == "torch" else value)


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


def function(name: str, value: Any) -> Any:
    """A function to call."""
    if not callable(value):
        raise QueryError(f"{name}: expected a function, found {arguments.described(value)}")
    return value


def duration(name: str, value: Any) -> float:
    """A time, which may be infinite."""
    number = arguments.real_number(name, value)
    if math.isnan(number):
        raise QueryError(f"{name} must be a number, found nan")
    return number


def share(name: str, value: Any) -> float:
    """A number from 0 to 1."""
    number = arguments.real_number(name, value)
    if not 0.0 <= number <= 1.0:
        raise QueryError(f"{name}: expected a number from 0 to 1, found {number:g}")
    return number


def roughness(name: str, value: Any) -> Any:
    """A number from 0 to 1, or a texture of them."""
    return share(name, value) if not getattr(value, "ndim", 0) else arguments.numbers(name, value)


def at_least(least: int, most: int | None = None) -> Check:
    """Check of a whole number."""

    def check(name: str, value: Any) -> int:
        number = arguments.whole_number(name, value)
        if number < least:
            raise QueryError(f"{name} must be at least {least}, found {number}")
        if most is not None and number > most:
            raise QueryError(f"{name} must be at most {most:,}, found {number:,}")
        return number

    return check


def one_of(*texts: str) -> Check:
    """Check of a text among a few."""

    def check(name: str, value: Any) -> str:
        if not isinstance(value, str) or value not in texts:
            expected = ", ".join(f'"{each}"' for each in texts)
            raise QueryError(f"{name}: expected one of {expected}, found {arguments.described(value)}")
        return value

    return check


def suns(name: str, value: Any) -> Any:
    """Directional lights."""
    if isinstance(value, str):
        return value  # refused by `shade`, which knows what was meant
    lights = list(value) if hasattr(value, "__iter__") else [value]
    if not all(hasattr(each, "irradiance") for each in lights):
        raise QueryError(
            f"{name}: expected directional lights, such as prt.suns_apart(lighting, degree).suns, found "
            f"{arguments.described(value)}"
        )
    return lights


def coverage(name: str, value: Any) -> Any:
    """Coverage of pixels, from 0 to 1."""
    array = arguments.numbers(name, value, "fiub")
    low, high = (array.min(), array.max()) if array.size else (0, 0)
    if not (low >= -_COVERAGE_ROUNDING and high <= 1.0 + _COVERAGE_ROUNDING):
        raise QueryError(f"{name}: expected coverage from 0 to 1, found {array.dtype} from {low:g} to {high:g}")
    return array


def names(name: str, value: Any) -> Any:
    """Names of the picture, the reference and the mask."""
    if isinstance(value, str) or not isinstance(value, Collection) or [type(each) for each in value] != [str] * 3:
        raise QueryError(
            f"{name}: expected three texts, for the picture, the reference and the mask, found "
            f"{arguments.described(value)}"
        )
    return tuple(value)


def exposures(name: str, value: Any) -> Any:
    """True, False, or the first and the last exposure."""
    if isinstance(value, list | tuple) and len(value) == 2:
        return tuple(arguments.finite_number(name, each) for each in value)
    return arguments.flag(name, value)


def text(name: str, value: Any) -> str:
    """A text."""
    if not isinstance(value, str):
        raise QueryError(f"{name}: expected a text, found {arguments.described(value)}")
    return value


def importance(name: str, value: Any) -> Any:
    """An importance module."""
    if not hasattr(value, "lobe"):
        raise QueryError(f"{name}: expected an importance module, found {arguments.described(value)}")
    return value


def record(kind: str) -> Check:
    """Check of a record of settings, by the name of its class."""

    def check(name: str, value: Any) -> Any:
        if type(value).__name__ != kind:
            raise QueryError(f"{name}: expected {kind}, found {arguments.described(value)}")
        return value

    return check


def collection(name: str, value: Any) -> Any:
    """Several names; a single one is refused where they are read."""
    if not isinstance(value, Collection):
        raise QueryError(f"{name}: expected a collection of names, found {arguments.described(value)}")
    return value


def layers(name: str, value: Any) -> tuple[str, ...]:
    """Names of layers."""
    if isinstance(value, str) or not isinstance(value, Collection):
        raise QueryError(f'{name}: expected names such as ("normal", "radiance"), found {arguments.described(value)}')
    return tuple(value)


def dictionary(name: str, value: Any) -> Any:
    """Entries by name."""
    if not isinstance(value, Mapping):
        raise QueryError(f"{name}: expected a dictionary, found {arguments.described(value)}")
    return value


def json_entries(name: str, value: Any) -> Any:
    """Entries by name, of the types that JSON has."""
    try:
        json.dumps(dictionary(name, value), allow_nan=False)
    except (TypeError, ValueError) as fault:
        raise QueryError(
            f"{name}: expected texts, numbers, lists and dictionaries of Python, as JSON has them ({fault})"
        ) from fault
    return value


def lights(name: str, value: Any) -> Any:
    """Files of skies and lights, or suns as text, one or several."""
    each = [value] if isinstance(value, str | bytes) or not hasattr(value, "__iter__") else list(value)
    return value if not [arguments.path(name, one) for one in each] else each


def coefficients(name: str, value: Any) -> Any:
    """Coefficients [K,3] of a light, or a record of them."""
    if hasattr(value, "coefficients") and not hasattr(value, "mesh"):
        return value
    array = (
        None
        if isinstance(value, str) or hasattr(value, "skies") or hasattr(value, "harmonics")
        else arguments.numbers(name, value)
    )
    if array is None or array.ndim != 2 or array.shape[1] != 3:
        raise QueryError(
            f"{name}: expected coefficients of shape [K, 3], as prt.project_environment(image) returns, found "
            f"{arguments.described(value if array is None else array)}"
        )
    return array


def axis(name: str, value: Any) -> str:
    """The axis that points up."""
    if isinstance(value, str) and value in ("y", "z"):
        return value
    raise QueryError(f'{name}: expected "y" or "z", the axis that points up, found {arguments.described(value)}')


def asset_file(name: str, value: Any) -> Any:
    """The path of an asset to write."""
    if Path(arguments.path(name, value)).suffix.lower() not in (".h5", ".hdf5"):
        raise QueryError(f"{name}: expected a name that ends in .h5 or .hdf5, found {arguments.described(value)}")
    return value


def checkpoint(name: str, value: Any) -> Path:
    """The path of a checkpoint."""
    return Path(arguments.path(name, value))


def keys(name: str, value: Any) -> Any:
    """Keys of random numbers: whole numbers from 0 on."""
    array = arguments.numbers(name, value)
    if array.dtype.kind not in "iu" or (array < 0).any():
        raise QueryError(f"{name}: expected whole numbers from 0 on, found {arguments.described(array)}")
    return array


def mask(name: str, value: Any) -> Any:
    """A mask: of booleans, of weights from 0 to 1, or of 8 or 16 bits, of which the largest number is white."""
    array = arguments.numbers(name, value, "fiub")
    if array.dtype.kind in "iu" and array.max(initial=0) > 1:
        if array.dtype not in (np.uint8, np.uint16):
            raise QueryError(
                f"{name}: expected weights from 0 to 1, found {array.dtype} up to {array.max()}; "
                "give booleans, such as mask > 0"
            )
        return array / np.iinfo(array.dtype).max
    return array


WHOLE = arguments.whole_number

KINDS: dict[str, Check] = {
    "asset": asset,
    "mesh": as_mesh,
    "scene": scene,
    "transport": transport,
    "lighting": lighting,
    "lights": lights,
    "camera": camera,
    "seed": at_least(0, 2**63 - 1),
    "mask": mask,
    "device": device,
    "leave_out": collection,
    "provenance": json_entries,
    "attributes": dictionary,
    **dict.fromkeys(("coefficients", "for_light"), coefficients),
    **dict.fromkeys(("image", "reference"), arguments.radiance),
    **dict.fromkeys(("eye", "target", "for_eye"), point),
    "alpha": coverage,
    "roughness": roughness,
    "normals": one_of("vertex", "face"),
    "hdr": exposures,
    "names": names,
    "scheduler": text,
    "importance": importance,
    **dict.fromkeys(("positions", "outgoing", "incident", "origin"), arguments.numbers),
    **dict.fromkeys(("degree", "rings", "sectors", "lobes", "most", "paths", "samples", "steps"), WHOLE),
    **dict.fromkeys(("spp", "width", "height", "most_rows"), WHOLE),
    **dict.fromkeys(("workers", "connections", "turns"), at_least(1)),
    **dict.fromkeys(("error", "fov", "extent", "scale"), arguments.real_number),
    **dict.fromkeys(("minutes", "every"), duration),
    **dict.fromkeys(("degrees", "rotate", "exposure"), arguments.finite_number),
    "settings": record("NetworkSettings"),
    "learning": record("LearningSettings"),
    "stream": record("StreamSettings"),
    **dict.fromkeys(("path", "out", "output", "folder"), arguments.path),
    "checkpoint": checkpoint,
    "up": axis,
    "keys": keys,
    **dict.fromkeys(("progress", "stop", "say", "preview", "part"), function),
}
"""The check of each name of an argument."""

OF_FUNCTION: dict[tuple[str, str], Check] = {
    ("shade", "light"): light_of_vertices,
    ("render_picture", "light"): light_of_picture,
    ("render_scene", "light"): light_of_picture,
    ("render_network", "light"): light_of_picture,
    ("render_network", "network"): transport,
    ("save_model", "network"): model,
    ("export_exr", "light"): coefficients,
    ("export_gltf", "light"): coefficients,
    ("bake", "transport"): baked,
    ("bake", "out"): asset_file,
    ("write_asset", "path"): asset_file,
    ("shade", "suns"): suns,
    ("srgb", "image"): visible,
    ("write_image", "layers"): dictionary,
    ("render_picture", "layers"): layers,
    ("render_picture", "samples"): at_least(1, 256),
    ("train", "samples"): arguments.path,
    ("train", "start"): model,
    ("train", "device"): device_name,
    ("estimate_coefficients", "device"): device_name,
}
"""Arguments whose name has another meaning in one function. Those that path trace find their GPU by other means."""
