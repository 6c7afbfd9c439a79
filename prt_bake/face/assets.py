"""Checks of an asset, its light and the eye, which need neither torch nor kernels."""

from typing import Any

import numpy as np

from formats import arguments
from formats.errors import QueryError, warn

_SAME_EYE = 1e-6


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


def eye_made_for(asset: Any) -> list[float] | None:
    """The only eye [3] that an asset was made for; None if it has view bins."""
    eye: list[float] | None = asset.provenance.get("settings", {}).get("for_eye")
    return eye


def warn_of_other_eye(asset: Any, eye: Any) -> None:
    """Issue an InputWarning if the asset was made for one eye, and this point [3] is another one."""
    made_for, point = eye_made_for(asset), np.asarray(eye, np.float64)
    if made_for is None or point.shape != (3,):
        return
    if (np.abs(point - made_for) > _SAME_EYE * (1.0 + np.abs(made_for))).any():
        warn(f"eye: the asset was made for the eye {made_for}: from other positions its colours are wrong")
