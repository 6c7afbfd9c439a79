"""Radiance at the vertices with all light in spherical harmonics and lobes.

Compiled kernels shade a frame ten times as fast as NumPy, but loading them takes longer than many frames. NumPy shades
until they are loaded, without lobes.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.asset.compact_record import CompactCoefficients
from prt_bake.face.assets import eye_made_for
from prt_bake.lights import environment
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.asset_light import AssetLight

if TYPE_CHECKING:
    from prt_bake.shading.frames.frames import Frames

_VERTICES_AT_ONCE = 1 << 12
_VERTICES_PER_THREAD = 1 << 16


class VertexRadiance:
    """Radiance at all valid vertices under a rotating light."""

    def __init__(self, asset: Asset) -> None:
        """Loads the kernels only for a compact asset, which NumPy does not read."""
        self._asset = asset
        terms = sh.count(asset.degree) if asset.quantity == "transfer" else 1
        self._light = AssetLight(None, whole=np.ones((terms, 3)))
        self._rotation = 0.0
        self._frames: Frames | None = None
        self._light_is_set = False
        self._last_eye: tuple[float, ...] = ()
        self._held_eye: tuple[float, ...] = ()
        self._radiance = np.zeros((len(asset.valid), 3), np.float32)
        if isinstance(asset.coefficients, CompactCoefficients):
            self.load()

    @property
    def loaded(self) -> bool:
        """Whether the compiled kernels are loaded."""
        return self._frames is not None

    def load(self) -> None:
        """Load the kernels. Another thread than the one that draws may call this if the latter uses no numba yet."""
        if self._frames is None:
            from prt_bake.shading.frames.frames import Frames

            frames, bounds = Frames(self._asset), self._asset.mesh.bounds
            if self._asset.quantity == "transfer":
                frames.light(self._light)
            frames.draw(eye_made_for(self._asset) or bounds[1] + self._asset.mesh.diagonal)
            # Assigned last, so that a concurrent `draw` sees either none or all of it and then sets its light.
            self._light_is_set = False
            self._frames = frames

    @property
    def lacks_lobes(self) -> bool:
        """Whether frames are drawn without the lobes of the light, because kernels are not loaded."""
        return self._frames is None and self._light.lobes is not None

    def set_light(self, light: AssetLight | NDArray[np.float64], rotation: float) -> None:
        """Set the light of the next frames.

        Args:
            light: prepared, or harmonics [K,3]; [1,3] for an asset made for one light.
            rotation: degrees about the asset's up axis; no effect on an asset made for one light.
        """
        prepared = light if isinstance(light, AssetLight) else AssetLight(light, whole=light)
        self._light, self._rotation, self._light_is_set = prepared, rotation, False

    def draw(self, eye: ArrayLike) -> NDArray[np.float32]:
        """Return the radiance [V,3] to the eye [3], as `Frames.draw`, in an array that every call reuses."""
        if self._frames is None:
            return self._draw_with_numpy(np.asarray(eye, np.float64))
        from prt_bake.jit.threads import using_threads

        relit = not self._light_is_set and self._asset.quantity == "transfer"
        if relit:
            self._frames.light(self._light)
            self._frames.turn(self._rotation)
        self._light_is_set = True
        # All but the largest objects take one thread about 1 ms. Waiting for a second thread takes longer if others,
        # such as those of VTK, are busy.
        with using_threads(1 + len(self._radiance) // _VERTICES_PER_THREAD):
            self._hold_resting_eye(self._frames, tuple(np.asarray(eye, np.float64).tolist()), relit)
            return self._frames.draw(eye)

    def _hold_resting_eye(self, frames: "Frames", eye: tuple[float, ...], relit: bool) -> None:
        """Interpolate between view bins once if the light moves and the eye rests."""
        if relit and eye == self._last_eye != self._held_eye:
            frames.hold(eye)
            self._held_eye = eye
        self._last_eye = eye

    def _draw_with_numpy(self, eye: NDArray[np.float64]) -> NDArray[np.float32]:
        asset, light = self._asset, self._light.whole
        if asset.quantity == "transfer":
            light = environment.rotate_light(light, self._rotation, asset.up)
        for rows in _chunks(np.flatnonzero(asset.valid)):
            outgoing = eye - asset.mesh.positions[rows]
            length = np.linalg.norm(outgoing, axis=1, keepdims=True)
            normals = asset.mesh.normals[rows]
            outgoing = np.where(length > 0.0, outgoing / np.where(length > 0.0, length, 1.0), normals)
            local = sphere.to_local(outgoing, normals, np.asarray(asset.tangents, np.float64)[rows])
            bins = sphere.bin_coordinates(local, asset.rings, asset.sectors)
            self._radiance[rows] = np.maximum(_reconstruct(asset.coefficients, rows, bins, asset.sectors, light), 0.0)
        return self._radiance


def _reconstruct(
    coefficients: Any, rows: NDArray[np.int64], at: sphere.BinCoordinates, sectors: int, light: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the unclamped radiance [n,3] of vertices `rows` [n], as `reconstruction.reconstruct` without numba."""

    def radiance_of(vertices: NDArray[np.int64], bins: Any) -> NDArray[np.float64]:
        return np.asarray((coefficients[vertices, bins] * light).sum(axis=-2))

    if coefficients.shape[1] == 1:
        return radiance_of(rows, 0)
    radiance = np.zeros((len(rows), 3))
    for ring, ring_weight in ((at.ring_low, 1.0 - at.ring_weight), (at.ring_high, at.ring_weight)):
        for sector, sector_weight in ((at.sector_low, 1.0 - at.sector_weight), (at.sector_high, at.sector_weight)):
            weight = (1.0 - at.pole_weight) * ring_weight * sector_weight
            radiance += weight[:, None] * radiance_of(rows, sectors * ring + sector)
    polar = np.flatnonzero(at.pole_weight > 0.0)
    for polar_sector in range(sectors if len(polar) else 0):
        radiance[polar] += at.pole_weight[polar, None] / sectors * radiance_of(rows[polar], polar_sector)
    return radiance


def _chunks(rows: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for first in range(0, len(rows), _VERTICES_AT_ONCE):
        yield rows[first : first + _VERTICES_AT_ONCE]
