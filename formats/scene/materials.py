"""Materials by name: measured ones and estimates, with their sources. The table is `materials.toml`."""

import difflib
import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Material:
    """A material of the table.

    Attributes:
        name: as in the source, in lower case.
        group: who measured it, or that it is an estimate, in a few words.
        source: the publication, and what was done to its numbers.
        sigma_s_reduced: reduced scattering σs′ = σs (1 − g), RGB, per millimetre.
        sigma_a: absorption, RGB, per millimetre.
        eta: index of refraction that the source assumes.
        roughness: GGX alpha of a usual surface; no source measured it.
        measured: whether the scattering and the absorption were measured.
    """

    name: str
    group: str
    source: str
    sigma_s_reduced: tuple[float, float, float]
    sigma_a: tuple[float, float, float]
    eta: float
    roughness: float
    measured: bool = True


@dataclass(frozen=True, eq=False)
class Substance:
    """Extinction `sigma_t` and scattering `sigma_s` of a homogeneous medium per scene unit, RGB, float64 [3]."""

    sigma_t: NDArray[np.float64]
    sigma_s: NDArray[np.float64]

    @property
    def albedo(self) -> NDArray[np.float64]:
        """Single-scattering albedo [3]; 1 without extinction."""
        return single_scattering_albedo(self.sigma_s, self.sigma_t)


ALIASES = {"chicken": "chicken1", "skin": "skin1", "milk": "wholemilk", "ocean": "pacificoceansurfacewater"}
"""Other names of materials. If two samples were measured, the name means the first."""
_ESTIMATE = "estimate"


@functools.cache
def materials() -> Mapping[str, Material]:
    """Return every material, by its name without spaces, in the order of the table.

    >>> materials()["marble"].sigma_s_reduced
    (2.19, 2.62, 3.0)
    """
    text = resources.files("formats.scene").joinpath("materials.toml").read_text(encoding="utf-8")
    found = {}
    for key, table in tomllib.loads(text).items():
        for name, row in table["materials"].items():
            found[_plain(name)] = Material(
                name=name,
                group=table["title"],
                source=table["source"],
                sigma_s_reduced=tuple(row["scattering"]),
                sigma_a=tuple(row["absorption"]),
                eta=row.get("eta", table["eta"]),
                roughness=row["roughness"],
                measured=key != _ESTIMATE,
            )
    return MappingProxyType(found)


def find_material(name: str) -> Material:
    """Return the material of this name; only its letters and digits count, in either case.

    Raises:
        KeyError: there is none; its argument suggests similar names, and where the list is.
    """
    plain, table = _plain(name), materials()
    material = table.get(ALIASES.get(plain, plain))
    if material is not None:
        return material
    names = {**{alias: alias for alias in ALIASES}, **{key: found.name for key, found in table.items()}}
    close = " or ".join(repr(names[key]) for key in difflib.get_close_matches(plain, names, n=3))
    raise KeyError(f"{f'did you mean {close}? ' if close else ''}`prtbake materials` lists all")


def _plain(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())


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
