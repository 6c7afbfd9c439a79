"""Arguments of public functions: what was found in place of what is expected, and numbers from any array library.

Each function returns the value in the type that the package works with, or raises QueryError with the argument's name.
"""

import math
import operator
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError, refuse_path

_DISPLAY = (np.uint8, np.uint16)
"""Types of pictures that are encoded for display."""
_KNOWN = {
    "Asset": "an asset",
    "Mesh": "a mesh",
    "NeuralBSSRDF": "a model",
    "Lighting": "a lighting",
    "AssetLight": "what prt.light_for returns",
    "SunsApart": "what prt.suns_apart returns",
    "Camera": "a camera",
    "Picture": "a picture; give its .image",
    "RenderedPicture": "a picture; give its .image",
    "Trimesh": "a trimesh mesh; prt.Mesh.from_trimesh(mesh) converts it",
    "PolyData": "a PyVista mesh; write it to a file and read that with prt.read_mesh",
}


def described(value: object) -> str:
    """What a value is, in words: "a model", "the text '0,1,4'", "an array [8, 16, 3] of uint8".

    >>> described([1.0, 2.0]), described(None), described("0,1,4")
    ('a list', 'None', "the text '0,1,4'")
    """
    name, origin = type(value).__name__, type(value).__module__.split(".")[0]
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str):
        return f"the text {value!r}" if len(value) < 60 else "a text"
    if isinstance(value, os.PathLike):
        return f"the path {os.fspath(value)!s}"
    if name == "Scene":
        return "a scene" if origin == "formats" else "a trimesh Scene; give one mesh, such as scene.to_mesh()"
    if origin == "PIL":
        return "a PIL image"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"an array {list(value.shape)} of {value.dtype}"
    return _KNOWN.get(name, f"{'an' if name[:1] in 'aeiouAEIO' else 'a'} {name}")


def require(name: str, value: object, attributes: Sequence[str], reader: str) -> None:
    """Refuse a value without these attributes; `reader` is the function that returns one with them."""
    refuse_path(name, value, reader)
    if not all(hasattr(value, attribute) for attribute in attributes) or isinstance(value, type):
        raise QueryError(f"{name}: expected what {reader}(path) returns, found {described(value)}")


def whole_number(name: str, value: Any) -> int:
    """An integer of Python or NumPy."""
    try:
        if not isinstance(value, bool):
            return operator.index(value)
    except TypeError:
        pass
    raise QueryError(f"{name} must be a whole number, found {described(value)}")


def real_number(name: str, value: Any) -> float:
    """A number, not a text or an array of one."""
    kind = getattr(getattr(value, "dtype", None), "kind", "f")
    try:
        if not isinstance(value, str | bytes | bool) and kind not in "bc" and not getattr(value, "ndim", 0):
            return float(value.detach() if hasattr(value, "detach") else value)
    except (TypeError, ValueError, OverflowError):
        pass
    raise QueryError(f"{name} must be a number, found {described(value)}")


def finite_number(name: str, value: Any) -> float:
    """A number that is neither infinite nor NaN."""
    number = real_number(name, value)
    if not math.isfinite(number):
        raise QueryError(f"{name}: expected a finite number, found {number}")
    return number


def flag(name: str, value: Any) -> bool:
    """True or False; a text such as "no" would count as True."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise QueryError(f"{name}: expected True or False, found {described(value)}")


def numbers(name: str, value: Any, kinds: str = "fiu") -> NDArray[Any]:
    """Real numbers as an array: of NumPy, of lists, of torch tensors, which are detached. kinds: of the dtype."""
    if isinstance(value, str):
        raise QueryError(f"{name}: expected an array of numbers, found {described(value)}")
    if isinstance(value, np.ma.MaskedArray) and (masked := int(np.ma.getmaskarray(value).sum())):
        raise QueryError(
            f"{name}: expected numbers, found a masked array without {masked} of them; give its .filled(number)"
        )
    try:
        if hasattr(value, "detach"):
            value = value.detach().cpu()
            value = (value.float() if value.element_size() <= 2 and value.is_floating_point() else value).numpy()
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as fault:
        raise QueryError(f"{name}: expected numbers in an array of one shape, found {described(value)}") from fault
    if array.dtype.kind not in kinds:
        found = f"{array.dtype} values" if array.ndim and array.dtype.kind != "O" else described(value)
        raise QueryError(f"{name}: expected real numbers, found {found}")
    return array


def radiance(name: str, value: Any) -> NDArray[Any]:
    """Linear radiance as an array; pictures that are encoded for display are refused."""
    refuse_path(name, value, "prt.read_image")
    if type(value).__module__.split(".")[0] == "PIL":
        found = "a PIL image, which is encoded for display"
    else:
        array = numbers(name, value)
        whole = hasattr(value, "dtype") and array.dtype.kind in "iu" and array.max(initial=0) > 1
        if array.dtype not in _DISPLAY and not whole:
            return array
        found = f"{array.dtype} values, which are {'' if array.dtype in _DISPLAY else 'usually '}encoded for display"
    raise QueryError(
        f"{name}: expected linear radiance in floating point, found {found}; prt.read_image(path) reads a file as "
        f"linear values"
    )


def path(name: str, value: Any) -> str | os.PathLike[str]:
    """The name of a file or a folder."""
    if isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str):
        return value
    raise QueryError(f"{name}: expected the path of a file, found {described(value)}")
