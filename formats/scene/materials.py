"""Measured materials by name, and units of length in millimetres.

The table is figure 5 of Jensen, Marschner, Levoy and Hanrahan, "A Practical Model for Subsurface Light Transport"
(2001): reduced scattering and absorption for red, green and blue per millimetre, and the index of refraction they
assume.
"""

import difflib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MILLIMETRES = {"mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "inch": 25.4}
"""Millimetres per unit of length."""


@dataclass(frozen=True)
class Material:
    """A measured material.

    Attributes:
        name: as in the paper, in lower case without spaces.
        sigma_s_reduced: reduced scattering σs′ = σs (1 − g), RGB, per millimetre.
        sigma_a: absorption, RGB, per millimetre.
        eta: index of refraction that the measurement assumes.
    """

    name: str
    sigma_s_reduced: tuple[float, float, float]
    sigma_a: tuple[float, float, float]
    eta: float = 1.3


@dataclass(frozen=True, eq=False)
class Substance:
    """Extinction `sigma_t` and scattering `sigma_s` of a homogeneous medium per scene unit, RGB, float64 [3]."""

    sigma_t: NDArray[np.float64]
    sigma_s: NDArray[np.float64]

    @property
    def albedo(self) -> NDArray[np.float64]:
        """Single-scattering albedo [3]; 1 without extinction."""
        return single_scattering_albedo(self.sigma_s, self.sigma_t)


_MEASURED = (
    Material("apple", (2.29, 2.39, 1.97), (0.0030, 0.0034, 0.046)),
    Material("chicken1", (0.15, 0.21, 0.38), (0.015, 0.077, 0.19)),
    Material("chicken2", (0.19, 0.25, 0.32), (0.018, 0.088, 0.20)),
    Material("cream", (7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163)),
    Material("ketchup", (0.18, 0.07, 0.03), (0.061, 0.97, 1.45)),
    Material("marble", (2.19, 2.62, 3.00), (0.0021, 0.0041, 0.0071), eta=1.5),
    Material("potato", (0.68, 0.70, 0.55), (0.0024, 0.0090, 0.12)),
    Material("skimmilk", (0.70, 1.22, 1.90), (0.0014, 0.0025, 0.0142)),
    Material("skin1", (0.74, 0.88, 1.01), (0.032, 0.17, 0.48)),
    Material("skin2", (1.09, 1.59, 1.79), (0.013, 0.070, 0.145)),
    Material("spectralon", (11.6, 20.4, 14.9), (0.0, 0.0, 0.0)),
    Material("wholemilk", (2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014)),
)
MATERIALS = {material.name: material for material in _MEASURED}
"""Every measured material, by name."""
ALIASES = {"chicken": "chicken1", "skin": "skin1"}
"""Other names of materials. If two samples were measured, the name means the first."""


def find_material(name: str) -> Material:
    """Return the material of this name, ignoring case, spaces, hyphens and underscores.

    Raises:
        KeyError: there is none; its argument suggests a similar name, or lists all.
    """
    plain = "".join(letter for letter in name.casefold() if letter not in " -_")
    material = MATERIALS.get(ALIASES.get(plain, plain))
    if material is not None:
        return material
    known = [*MATERIALS, *ALIASES]
    close = difflib.get_close_matches(plain, known, n=1)
    raise KeyError(f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(sorted(known))}")


def to_scene_units(material: Material, phase_g: float, unit_in_mm: float, density: float = 1.0) -> Substance:
    """Return the extinction and scattering of a material per scene unit.

    Args:
        material: the material.
        phase_g: mean cosine g of the phase function; σs = σs′ / (1 − g) by the similarity relation.
        unit_in_mm: millimetres per scene unit.
        density: factor on scattering and absorption.
    """
    scale = density * unit_in_mm
    sigma_s = scale * np.array(material.sigma_s_reduced) / (1.0 - phase_g)
    return Substance(sigma_s + scale * np.array(material.sigma_a), sigma_s)


def single_scattering_albedo(sigma_s: NDArray[np.float64], sigma_t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return σs / σt, between 0 and 1; 1 without extinction."""
    albedo: NDArray[np.float64] = np.minimum(
        np.where(sigma_t > 0, sigma_s, 1.0) / np.where(sigma_t > 0, sigma_t, 1.0), 1.0
    )
    return albedo
