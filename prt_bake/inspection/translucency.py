"""How far light travels in a medium, beside the size of the object: whether it will look translucent."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh, open_edges, signed_volume
from formats.scene.medium import Medium

Array = NDArray[np.float64]

_THIN = 0.1
"""Thickness of the thin parts of an object as a share of its longest side, unless its walls are thinner."""
_OPAQUE = 1e-3
"""Share of diffuse light through the thin parts below which nothing is seen to glow."""
_CLEAR = 0.05
"""Share of white light that crosses the longest side straight, above which an object looks almost clear.

The limit is three transport mean free paths in grey media. Of the light that leaves a smooth ball of index 1.4 and that
size, 7 % has not scattered; of a cow with thin legs, 27 % (at five mean free paths 1 and 15 %).
"""
_SCATTERS = 0.5
"""Reduced albedo below which light is absorbed before it spreads, in an object of any size."""
_TRANSLUCENT = (5.0, 50.0)
"""Longest sides in transport mean free paths that look translucent."""
GUIDE = "translucent looks need an object of some {:g} to {:g} transport mean free paths".format(*_TRANSLUCENT)


@dataclass(frozen=True, eq=False)
class Translucency:
    """Mean free paths in a homogeneous medium, and the light that crosses thin parts of the object, RGB, float64 [3].

    Attributes:
        size: longest side of the object.
        thin: thickness of its thin parts.
        mean_free_path: 1 / σt, between two events.
        transport: 1 / (σa + σs′), until the direction is forgotten; σs′ = σs (1 − g).
        albedo: σs′ / (σa + σs′); 0 without extinction.
        diffuse: 1 / √(3 σa (σa + σs′)), the distance over which diffuse light falls to 1/e; infinite without
            absorption.
        crossing: diffuse transmittance of a slab of thickness `thin`, from 0 to 1.

    All lengths have the unit of `size`.

    >>> light = translucency(np.array([2.19, 2.62, 3.0]), np.array([0.0021, 0.0041, 0.0071]), 0.0, 140.0)
    >>> light.transport.round(2).tolist(), light.diffuse.round(1).tolist(), light.crossing.round(3).tolist()
    ([0.46, 0.38, 0.33], [8.5, 5.6, 4.0], [0.033, 0.017, 0.007])
    """

    size: float
    thin: float
    mean_free_path: Array
    transport: Array
    albedo: Array
    diffuse: Array
    crossing: Array

    @property
    def opaque(self) -> bool:
        """Whether no channel lets enough light through the thin parts to be seen."""
        return bool(self.crossing.max() < _OPAQUE)

    @property
    def percent_crossing(self) -> str:
        """The light that crosses the thin parts as text, of the channels that are not dark to two digits."""
        return f"{channels(np.where(self.crossing < 5e-5, 0.0, 100.0 * self.crossing))} %"

    @property
    def clear(self) -> bool:
        """Whether much of the light crosses the object straight."""
        return bool(self.straight.mean() > _CLEAR)

    @property
    def straight(self) -> Array:
        """The light that crosses the longest side straight, RGB [3]: exp(−thickness / transport).

        Light that is scattered forwards is nearly straight, so the phase function does not matter.
        """
        return np.exp(-self.size / self.transport)

    @property
    def scatters(self) -> bool:
        """Whether some channel scatters enough to look translucent at some size."""
        return bool(self.albedo.max() >= _SCATTERS)


def lengths(mesh: Mesh) -> tuple[float, float]:
    """Return the longest side of a mesh, and the thickness of its thin parts.

    The latter is a tenth of the longest side, or twice the volume over the area if that is less: in a cup, a leaf or a
    bowl, the thickness of the wall.

    >>> from formats.mesh import build_mesh
    >>> import trimesh
    >>> plate = trimesh.creation.box((10.0, 10.0, 0.1))
    >>> size, thin = lengths(build_mesh(plate.vertices, plate.faces))
    >>> round(size, 3), round(thin, 3)
    (10.0, 0.098)
    """
    longest, area = float(np.ptp(mesh.bounds, axis=0).max()), float(mesh.face_areas.sum())
    if open_edges(mesh) or area == 0.0:
        return longest, _THIN * longest
    return longest, min(_THIN * longest, 2.0 * abs(signed_volume(mesh)) / area)


def translucency(
    sigma_s: Array, sigma_a: Array, phase_g: float, size: float, thin: float | None = None
) -> Translucency:
    """Return how far light travels in a medium of scattering and absorption [3], in an object of this longest side.

    Its thin parts are a tenth of that by default, as `lengths` says.

    The transmittance is that of the diffusion equation with extrapolated boundaries, 2/3 of a transport mean free path
    outside the slab, and its source one transport mean free path inside.
    """
    sigma_t, reduced = sigma_s + sigma_a, sigma_a + (1.0 - phase_g) * sigma_s
    albedo = np.divide(reduced - sigma_a, reduced, out=np.zeros_like(reduced), where=reduced > 0.0)
    with np.errstate(divide="ignore"):
        transport = 1.0 / reduced
        diffuse = 1.0 / np.sqrt(3.0 * sigma_a * reduced)
        mean_free_path = 1.0 / sigma_t
    thin = _THIN * size if thin is None else thin
    crossing = np.array([_slab(*pair, thin) for pair in zip(transport, diffuse, strict=True)])
    return Translucency(size, thin, mean_free_path, transport, albedo, diffuse, crossing)


def of_medium(medium: Medium, mesh: Mesh) -> Translucency | None:
    """Return that of a part's medium, of the mean over its grids; None without extinction."""
    sigma_t, albedo = _mean(medium.sigma_t), _mean(medium.albedo)
    if not (sigma_t > 0.0).any():
        return None
    return translucency(albedo * sigma_t, (1.0 - albedo) * sigma_t, medium.phase_g, *lengths(mesh))


def describe(light: Translucency, millimetres: float | None) -> dict[str, Any]:
    """Return the lengths as text under readable names, in millimetres or, if these are not known, in scene units."""
    scale, unit = (1.0, "scene units") if millimetres is None else (millimetres, "mm")
    return {
        "longest side": f"{light.size * scale:.4g} {unit}",
        "mean free path": f"{channels(light.mean_free_path * scale)} {unit}",
        "transport mean free path": f"{channels(light.transport * scale)} {unit}",
        "diffuse mean free path": f"{channels(light.diffuse * scale)} {unit}",
        "longest side in transport mean free paths": channels(light.size / light.transport),
        "thin parts": f"{light.thin * scale:.3g} {unit}",
        "diffuse light through thin parts": light.percent_crossing,
    }


def remark(light: Translucency, millimetres: float | None) -> str:
    """Return a sentence if the object would look opaque or clear, with what looks translucent; else an empty text."""
    scale, unit = (1.0, "scene units") if millimetres is None else (millimetres, "mm")
    found = (
        f"the transport mean free path is {channels(light.transport * scale)} {unit} in an object of "
        f"{light.size * scale:.4g} {unit}"
    )
    if light.opaque:
        return (
            f"it will look opaque: {found}, and less than {_OPAQUE:.1%} of the light crosses its thin parts of "
            f"{light.thin * scale:.3g} {unit}; {_advice(light, scale, unit)}"
        )
    if light.clear:
        straight = channels(100.0 * light.straight.round(3))
        return (
            f"it is almost clear: {found}, and {straight} % of the light crosses it straight, which models and assets "
            f"lack or blur; {_advice(light, scale, unit)}"
        )
    return ""


def _advice(light: Translucency, scale: float, unit: str) -> str:
    """Return the sizes and the factors on sigma_t at which the channel that scatters least looks translucent."""
    if not light.scatters:
        return (
            "it absorbs more than it scatters, so no size or density looks translucent: raise albedo, or choose "
            "another material"
        )
    sizes = np.array(_TRANSLUCENT) * light.transport[np.isfinite(light.transport)].max()
    least, most = (digits(float(f"{size:.2g}")) for size in sizes * scale)
    low, high = (digits(float(f"{factor:.2g}")) for factor in sizes / light.size)
    return (
        f"{GUIDE}: here a longest side of {least} to {most} {unit}, or {low} to {high} times the sigma_t (of a "
        f"material, density)"
    )


def translucent_size(light: Translucency) -> str:
    """Return a longest side that looks translucent, for an object in millimetres: 20 transport mean free paths.

    >>> translucent_size(translucency(np.full(3, 2.0), np.zeros(3), 0.0, 9000.0))
    '1cm'
    """
    return f"{float(f'{2.0 * light.transport.max():.1g}'):g}cm"


def channels(values: Array) -> str:
    """Return three numbers as text, or one if they are equal to its digits; infinity is "unlimited"."""
    texts = ["unlimited" if value == np.inf else digits(float(value)) for value in values]
    return texts[0] if len(set(texts)) == 1 else ", ".join(texts)


def digits(value: float) -> str:
    """Return a number with three digits, or more before the point."""
    return f"{value:,.0f}" if value >= 1000.0 else f"{value:.3g}"


def _slab(transport: float, diffuse: float, thickness: float) -> float:
    """Return the diffuse transmittance of a slab, at most 1."""
    if transport == np.inf:
        return 1.0
    source, whole = 5.0 / 3.0 * transport, thickness + 4.0 / 3.0 * transport
    near, far = source / diffuse, whole / diffuse
    if far < 1e-6:
        return min(1.0, source / whole)
    # sinh(near) / sinh(far), where both may overflow
    return float(min(1.0, np.exp(near - far) * np.expm1(-2.0 * near) / np.expm1(-2.0 * far)))


def _mean(quantity: Array) -> Array:
    """Return the mean over the cells of a grid [Z,Y,X] or [Z,Y,X,3], a number or RGB, as RGB [3]."""
    mean = quantity.mean(axis=(0, 1, 2)) if quantity.ndim > 2 else quantity
    return np.broadcast_to(mean, 3).astype(np.float64)
