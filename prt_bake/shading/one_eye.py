"""Assets that were made for one eye, which show wrong colours from elsewhere. Loads no kernels."""

import numpy as np
from numpy.typing import ArrayLike

from formats.asset import Asset
from formats.errors import warn

_SAME = 1e-6


def eye_made_for(asset: Asset) -> list[float] | None:
    """Return the only eye [3] that the asset was made for; None if it has view bins."""
    eye: list[float] | None = asset.provenance.get("settings", {}).get("for_eye")
    return eye


def warn_of_other_eye(asset: Asset, eye: ArrayLike) -> None:
    """Issue an InputWarning if the asset was made for one eye, and this point [3] is another one."""
    made_for, point = eye_made_for(asset), np.asarray(eye, np.float64)
    if made_for is None or point.shape != (3,):
        return
    if (np.abs(point - made_for) > _SAME * (1.0 + np.abs(made_for))).any():
        warn(f"eye: the asset was made for the eye {made_for}: from other positions its colours are wrong")
