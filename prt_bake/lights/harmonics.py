"""Spherical harmonics of a lighting: of its skies and directional lights together."""

import math

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.scene.lights import DirectionalLight
from prt_bake.lights import environment
from prt_bake.lights.lighting import Lighting
from prt_bake.mathematics import sh

Array = NDArray[np.float64]


def project_lighting(lighting: Lighting, degree: int) -> Array:
    """Coefficients b_lm = ∫ L Y_lm dω [K,3], in object space, of all lights.

    Skies are projected by `environment.project`; the residual of a downsampled sky is added. Discs are exact. A light
    without size is a delta function with its irradiance. Raises QueryError if a sky was downsampled for a lower degree.
    """
    total = np.zeros((sh.count(degree), 3))
    for sky in lighting.skies:
        own = environment.project(sky.image, degree, sky.up)
        if sky.residual is not None:
            if len(sky.residual) < len(own):
                raise QueryError(
                    f"light: was read for harmonics to degree {sh.degree_of(len(sky.residual))}, not {degree}; read it "
                    f"with degree={degree}"
                )
            own += sky.residual[: len(own)]
        total += sh.rotation(sky.turn, degree) @ own
    for sun in lighting.suns:
        shape = np.repeat(_disc_means(sun, degree), 2 * np.arange(degree + 1) + 1)
        total += (shape * sh.evaluate(sun.direction, degree))[:, None] * sun.irradiance
    return total


def _disc_means(sun: DirectionalLight, degree: int) -> Array:
    """The mean of each Legendre polynomial P_l [degree+1] over the light's disc, about its axis: 1 without size."""
    nodes, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    # The cosine is uniform between 1 and that of the rim; 1 − cosine keeps its digits for small discs.
    fall = 2.0 * math.sin(math.radians(sun.angular_diameter) / 4.0) ** 2
    cosine = 1.0 - fall * (0.5 + 0.5 * nodes)
    return np.asarray(0.5 * weights @ np.polynomial.legendre.legvander(cosine, degree))
