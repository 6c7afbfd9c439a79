"""Plain functions as transports: `f(incident, positions, outgoing)` in place of an object with `evaluate`."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bakers.transport import as_radiance
from formats.errors import QueryError

ARGUMENTS = ("incident", "positions", "outgoing")
_METHODS = ("evaluate", "evaluate_block", "estimate_coefficients")


def as_transport(value: Any) -> Any:
    """An object with a method of a transport as it is, any other callable as a transport that evaluates it.

    Raises QueryError for a function, or a method evaluate, that does not take three arguments, or takes those of the
    names `ARGUMENTS` in another order.

    >>> as_transport(lambda incident, positions, outgoing: incident).evaluate([[0, 0, 1]], [[0, 1, 0]], [[0, 1, 0]])
    array([[[0, 0, 1]]])
    """
    if any(hasattr(value, method) for method in _METHODS):
        if hasattr(value, "evaluate"):
            _refuse_other_arguments(value.evaluate, f"{type(value).__name__}.evaluate")
        return value
    if not callable(value):
        return value  # refused by `transport_kind`, which names the methods
    name = getattr(value, "__name__", type(value).__name__)
    # The call of a torch module takes anything; its forward does not.
    _refuse_other_arguments(getattr(value, "forward", value), name)
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
        light, points = np.asarray(incident), np.asarray(positions)
        light = np.broadcast_to(light, (len(points), *light.shape[-2:]))
        return as_radiance(self._function(light, points, np.asarray(outgoing)), light.shape, self.label)


def _refuse_other_arguments(function: Callable[..., Any], name: str) -> None:
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # compiled functions without a signature
    expected = f"expected a function of ({', '.join(ARGUMENTS)})"
    try:
        bound = signature.bind(*ARGUMENTS).arguments
    except TypeError:
        raise QueryError(f"transport: {expected}, found {name}{_named(signature)}") from None
    if sorted(bound) == sorted(ARGUMENTS) and tuple(bound) != ARGUMENTS:
        raise QueryError(f"transport: {expected} in this order, found {name}{_named(signature)}")


def _named(signature: inspect.Signature) -> str:
    return f"({', '.join(map(str, signature.parameters))})"
