"""Checks of an asset, its light and the eye, which need no torch."""

from typing import Any

import numpy as np

from formats import arguments
from formats.errors import QueryError


def asset(name: str, value: Any) -> Any:
    """A baked asset."""
    if hasattr(value, "evaluate") and not hasattr(value, "coefficients"):
        found = arguments.described(value)
        raise QueryError(f"{name}: expected an asset, found {found}; bake it first: prt.bake(model, mesh)")
    arguments.require(name, value, ("coefficients", "mesh", "valid"), "prt.read_asset")
    if hasattr(type(value.coefficients), "file") and not value.coefficients:  # an open dataset counts as true
        raise QueryError(f"{name}: its file is closed; read it again: prt.read_asset(path)")
    return value


def light_of_vertices(name: str, value: Any) -> Any:
    """Coefficients, or what `light_for` returns; None for an asset that was made for one light."""
    if value is None or hasattr(value, "harmonics"):
        return value
    if hasattr(value, "skies") or isinstance(value, str) or hasattr(value, "__fspath__"):
        raise QueryError(
            f"{name}: expected what prt.light_for(asset, prt.read_lighting(path)) returns, or coefficients [K, 3], "
            f"such as those of suns_apart (.harmonics) or project_environment, found {arguments.described(value)}"
        )
    return arguments.numbers(name, value)


def point(name: str, value: Any) -> Any:
    """A point, or directions to it."""
    if isinstance(value, str):
        raise QueryError(f"{name}: expected numbers such as [0, 1, 4], found {arguments.described(value)}")
    if hasattr(value, "eye"):
        raise QueryError(f"{name}: expected real numbers, found {arguments.described(value)}; give its .eye")
    array = arguments.numbers(name, value)
    if array.shape == (3,) and not np.isfinite(array).all():
        raise QueryError(f"{name}: expected a point of three finite numbers, found {array.tolist()}")
    return array
