"""The error of a picture in one figure: of the network, the bake, view bins, vertices and reflected rays together."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.summary import summary
from prt_bake.mathematics.sphere import BinCoordinates
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.vertices import bin_coordinates_at_vertices, eye_directions

Array = NDArray[np.float64]

_MOST_VERTICES = 2000
"""Vertices at which the interpolation between view bins is examined."""


@dataclass(frozen=True)
class PictureError:
    """The relative RMSE of the object's radiance in a picture, part by part; None for what is unknown.

    Attributes:
        network: of the network compared with path tracing, as the trainer measured it on the coefficients of the whole
            surface and all views.
        bake: of the coefficients compared with what was baked.
        views: of the interpolation between view bins.
        vertices: of the interpolation between vertices.
        noise: of reflected rays; 0 without a reflection.
        path_traced: whether a scene was baked, without a network.
        suns: of suns beside harmonics (`prt_bake.shading.lobed_suns`); 0 without suns.

    >>> print(PictureError(0.03, 0.021, 0.008, 0.024, 0.0))
    about 4.5% (network 3.0%, bake 2.1%, views 0.8%, vertices 2.4%, noise 0.0%)
    >>> print(PictureError(None, 0.021, 0.008, 0.024, 0.0))
    at least 3.3% (network unknown, bake 2.1%, views 0.8%, vertices 2.4%, noise 0.0%)
    """

    network: float | None
    bake: float | None
    views: float | None
    vertices: float | None
    noise: float
    path_traced: bool = False
    suns: float | None = 0.0

    __repr__ = summary

    @property
    def known(self) -> bool:
        """Whether every part is known."""
        return None not in self._parts.values()

    @property
    def total(self) -> float | None:
        """The root of the sum of the squares of the known parts; None if network and bake are both unknown."""
        if self.network is None and self.bake is None and not self.path_traced:
            return None
        if self.path_traced and self.bake is None:
            return None
        return math.sqrt(sum(part**2 for part in self._parts.values() if part is not None))

    def as_json(self) -> dict[str, Any]:
        """The total and the parts; None for unknown."""
        return {"total": self.total, "complete": self.known, **self._parts}

    @property
    def _parts(self) -> dict[str, float | None]:
        network = {} if self.path_traced else {"network": self.network}
        parts = {**network, "bake": self.bake, "views": self.views, "vertices": self.vertices, "noise": self.noise}
        return parts if self.suns == 0.0 else parts | {"suns": self.suns}

    def __str__(self) -> str:
        parts = [f"{name} {'unknown' if part is None else f'{part:.1%}'}" for name, part in self._parts.items()]
        inside = ", ".join(["path traced"] * self.path_traced + parts)
        if self.total is None:
            return f"unknown ({inside})"
        return f"{'about' if self.known else 'at least'} {self.total:.1%} ({inside})"


def view_error(asset: Asset, light: Array, eye: Any, shares: Array, radiance: Array, sigma: Array) -> float | None:
    """Relative RMSE of the radiance by the interpolation between view bins; None if unknown.

    light: from `light_coefficients`; shares: of the vertices in the picture [V]; radiance and its standard error sigma
    [V,3]. Linear interpolation at the share t between two bins is off by
    ½ t (1 − t) times the second difference of three bins, to leading order. Beyond the centre of the last ring the
    value is clamped, and compared with a parabola through three rings. Around the normal, see `_pole_error`. The error
    is unknown with fewer than three rings or four sectors. What differences of bins have of the bake's own error is
    subtracted. The interpolation of lobes is left out.
    """
    if asset.coefficients.shape[1] == 1:
        return 0.0 if len(asset.directions) > 1 else None
    if asset.rings < 3 or asset.sectors < 4:
        return None
    vertices = np.flatnonzero(asset.valid & (shares > 0.0))
    vertices = vertices[:: max(1, len(vertices) // _MOST_VERTICES)]
    share = shares[vertices][:, None]
    signal = float((share * radiance[vertices] ** 2).sum())
    if signal <= 0.0:
        return None
    outgoing = eye_directions(asset, eye, vertices)
    at = bin_coordinates_at_vertices(asset, outgoing, vertices)

    def value(places: BinCoordinates, some: slice | NDArray[np.int64] = slice(None)) -> Array:
        return reconstruct(asset.coefficients, vertices[some], places, asset.sectors, light)

    low, middle, high = (value(places) for places in _rings(at, asset.rings))
    before, here, after = (value(places) for places in _sectors(at, asset.sectors))
    ring, sector = at.ring_weight[:, None], at.sector_weight[:, None]
    error = 0.5 * ring * (1.0 - ring) * (2.0 * middle - low - high)
    error += 0.5 * sector * (1.0 - sector) * (2.0 * here - before - after)
    cosine = np.einsum("ni,ni->n", outgoing, asset.mesh.normals[vertices])
    beyond = (0.5 - asset.rings * np.clip(cosine, 0.0, 0.5 / asset.rings))[:, None]
    error += beyond * (high - middle) + 0.5 * beyond * (1.0 + beyond) * (low - 2.0 * middle + high)
    polar = np.flatnonzero(at.pole_weight > 0.0)
    near = BinCoordinates._make(part[polar] for part in at)
    error[polar] += _pole_error(near, asset.sectors, lambda places: value(places, polar))
    noise = _noise_of_differences(asset, vertices, at) * sigma[vertices] ** 2
    return math.sqrt(max(0.0, float((share * (error**2 - noise)).sum())) / signal)


def _noise_of_differences(asset: Asset, vertices: NDArray[np.int64], at: BinCoordinates) -> Array:
    """Variance [n,1] of the error from second differences, over that of the interpolated radiance.

    Only what the errors of view bins do not have in common counts: a second difference has six times its variance.
    """
    if asset.error_covariance is None:
        return np.zeros((len(vertices), 1))
    independent = asset.error_covariance.at_vertices(vertices).apart[:, 0].astype(np.float64)
    ring, sector = at.ring_weight * (1.0 - at.ring_weight), at.sector_weight * (1.0 - at.sector_weight)
    averaged = 1.0 - independent * (1.0 - (1.0 - 2.0 * ring) * (1.0 - 2.0 * sector))
    return np.asarray(1.5 * independent * (ring**2 + sector**2) / averaged)[:, None]


def _pole_error(at: BinCoordinates, sectors: int, value: Callable[[BinCoordinates], Array]) -> Array:
    """Error [n,3] between the normal and the centre of ring 0, where the value runs to the mean of the ring.

    What turns with the azimuth grows like the sine of the angle to the normal, not like its versine. The mean over
    azimuths goes on at the normal as it runs from ring 1, where four sectors a quarter turn apart give it, to ring 0.
    """
    nothing = np.zeros_like(at.pole_weight)
    mean = value(at._replace(pole_weight=nothing + 1.0))
    first = value(at._replace(pole_weight=nothing))
    second = np.zeros_like(mean)
    for quarter in range(4):
        sector = (at.sector_low + quarter * sectors // 4) % sectors
        ring = np.ones_like(at.ring_low)
        second += 0.25 * value(BinCoordinates(ring, ring, nothing, sector, sector, nothing, nothing))
    inside = (1.0 - at.pole_weight)[:, None]
    return np.asarray((np.sqrt(inside) - inside) * (first - mean) + 0.5 * (1.0 - inside) * (mean - second))


def _rings(at: BinCoordinates, rings: int) -> Iterator[BinCoordinates]:
    """The three rings around the nearest one, between the same sectors."""
    nearest = np.clip(np.where(at.ring_weight > 0.5, at.ring_high, at.ring_low), 1, rings - 2)
    nothing = np.zeros_like(at.ring_weight)
    for step in (-1, 0, 1):
        ring = nearest + step
        yield at._replace(ring_low=ring, ring_high=ring, ring_weight=nothing, pole_weight=nothing)


def _sectors(at: BinCoordinates, sectors: int) -> Iterator[BinCoordinates]:
    """The three sectors around the nearest one, between the same rings."""
    nearest = np.where(at.sector_weight > 0.5, at.sector_high, at.sector_low)
    nothing = np.zeros_like(at.ring_weight)
    for step in (-1, 0, 1):
        sector = (nearest + step) % sectors
        yield at._replace(sector_low=sector, sector_high=sector, sector_weight=nothing, pole_weight=nothing)
