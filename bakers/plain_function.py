"""Plain functions as transports: `f(incident, positions, outgoing)` in place of an object with `evaluate`."""

import inspect
import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bakers.transport import as_radiance, transport_property
from formats.arguments import described, finite_number, numbers
from formats.errors import QueryError

ARGUMENTS = ("incident", "positions", "outgoing")
_METHODS = {
    "evaluate": ARGUMENTS,
    "evaluate_block": ("incident", "rotation", "positions", "outgoing"),
    "estimate_coefficients": ("positions", "outgoing", "degree", "paths", "seed"),
}
"""The methods of a transport, any of which is enough, and their arguments."""
_OTHERS = {"on": ("mesh",), "refuse_foreign": ("mesh",)}


def as_transport(value: Any) -> Any:
    """An object with a method of a transport as it is, any other callable as a transport that evaluates it.

    Raises QueryError for a function or a method that takes other arguments, or takes those of the names `ARGUMENTS` in
    another order, and for metadata that an asset cannot hold.

    >>> as_transport(lambda incident, positions, outgoing: incident).evaluate([[0, 0, 1]], [[0, 1, 0]], [[0, 1, 0]])
    array([[[0, 0, 1]]])
    """
    if any(hasattr(value, method) for method in _METHODS):
        name = type(value).__name__
        for method, arguments in (_METHODS | _OTHERS).items():
            if hasattr(value, method):
                _refuse_other_arguments(getattr(value, method), f"{name}.{method}", arguments)
        _refuse_other_metadata(value, name)
        return value
    if not callable(value):
        return value  # refused by `transport_kind`, which names the methods
    name = getattr(value, "__name__", type(value).__name__)
    # The call of a torch module takes anything; its forward does not.
    _refuse_other_arguments(getattr(value, "forward", value), name, ARGUMENTS)
    return PlainFunction(value, name)


class PlainFunction:
    """A function f(incident [N,D,3], positions [N,3], outgoing [N,3]) → Ŝ [N,D,3] as a transport."""

    def __init__(self, function: Callable[..., Any], name: str) -> None:
        """Name the asset's transport `name`."""
        self.metadata = {"name": name}
        self.label = f"function {name}"
        self._function = function

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[Any]:
        """Ŝ [N,D,3] for incident [D,3], which the function gets as [N,D,3], or [N,D,3].

        Raises QueryError if the function returns anything but real numbers of this shape.
        """
        light, points = np.asarray(incident), np.array(positions)
        # Copies, which the function may write into, and which torch takes without a warning.
        light = np.array(np.broadcast_to(light, (len(points), *light.shape[-2:])))
        return as_radiance(self._function(light, points, np.array(outgoing)), light.shape, self.label)


def _refuse_other_metadata(value: Any, name: str) -> None:
    """Refuse metadata that are no dictionary of what JSON holds, and properties of the surface that are no numbers."""
    metadata = getattr(value, "metadata", None) or {}
    if not isinstance(metadata, Mapping):
        raise QueryError(f"transport: expected a dictionary as {name}.metadata, found {described(metadata)}")
    for key, entry in metadata.items():
        try:
            json.dumps(entry, allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise QueryError(
                f"transport: expected text, finite numbers, and lists and dictionaries of these in {name}.metadata, "
                f"found {described(entry)} as {key!r}"
            ) from None
    if finite_number(f"transport: eta of {name}", transport_property(value, "eta", 1.0)) <= 0.0:
        raise QueryError(f"transport: expected eta above 0, found {transport_property(value, 'eta', 1.0)} of {name}")
    if (roughness := transport_property(value, "roughness", None)) is not None:
        numbers(f"transport: roughness of {name}", roughness)
    if (up := transport_property(value, "up", "y")) not in ("y", "z"):
        raise QueryError(f"transport: expected 'y' or 'z' as up of {name}, found {described(up)}")


def _refuse_other_arguments(function: Any, name: str, arguments: tuple[str, ...]) -> None:
    if not callable(function):
        raise QueryError(f"transport: expected a method {name}({', '.join(arguments)}), found {described(function)}")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # compiled functions without a signature
    expected = f"expected a function of ({', '.join(arguments)})"
    try:
        bound = signature.bind(*arguments).arguments
    except TypeError:
        raise QueryError(f"transport: {expected}, found {name}{_named(signature)}") from None
    if sorted(bound) == sorted(arguments) and tuple(bound) != arguments:
        raise QueryError(f"transport: {expected} in this order, found {name}{_named(signature)}")


def _named(signature: inspect.Signature) -> str:
    return f"({', '.join(map(str, signature.parameters))})"
