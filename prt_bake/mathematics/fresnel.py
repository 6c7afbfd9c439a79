"""Reflection at smooth dielectric interfaces, for kernels."""

import math
from typing import Any

from prt_bake.jit.kernel_functions import inlined_function


@inlined_function()
def fresnel(cosine: Any, eta: Any) -> Any:
    """Fresnel reflectance of unpolarised light at `cosine` ≥ 0; 1 for total internal reflection.

    eta: the refractive index beyond the interface over that before it.
    """
    squared = 1.0 - (1.0 - cosine * cosine) / (eta * eta)
    if squared <= 0.0:
        return 1.0
    other = math.sqrt(squared)
    parallel = (eta * cosine - other) / (eta * cosine + other)
    perpendicular = (cosine - eta * other) / (cosine + eta * other)
    return 0.5 * (parallel * parallel + perpendicular * perpendicular)
