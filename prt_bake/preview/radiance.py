"""What the vertices of an asset send to the eye with all light as harmonics, from the first frame on.

Compiled kernels draw a frame in a tenth of the time that NumPy takes, but to load them takes longer than many frames of
NumPy's. Until they are loaded NumPy draws.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.asset.compact_record import CompactCoefficients
from prt_bake.lights import environment
from prt_bake.mathematics import sh, sphere

if TYPE_CHECKING:
    from prt_bake.shading.frames.frames import Frames

_VERTICES_AT_ONCE = 1 << 12
_VERTICES_A_THREAD = 1 << 16


class VertexRadiance:
    """Radiance at all valid vertices under harmonics that turn."""

    def __init__(self, asset: Asset) -> None:
        """Holds no kernels yet, but for a compact asset, which NumPy does not read."""
        self._asset = asset
        terms = sh.count(asset.degree) if asset.quantity == "transfer" else 1
        self._light = np.ones((terms, 3))
        self._turned = 0.0
        self._frames: Frames | None = None
        self._lit = False
        self._drawn_for: tuple[float, ...] = ()
        self._held_for: tuple[float, ...] = ()
        self._radiance = np.zeros((len(asset.valid), 3), np.float32)
        if isinstance(asset.coefficients, CompactCoefficients):
            self.load()

    @property
    def loaded(self) -> bool:
        """Whether the compiled kernels draw."""
        return self._frames is not None

    def load(self) -> None:
        """Load the kernels; from another thread than the one that draws, too, if it does nothing else of numba's."""
        if self._frames is None:
            from prt_bake.shading.frames.frames import Frames

            frames = Frames(self._asset)
            if self._asset.quantity == "transfer":
                frames.light(self._light)
            frames.draw(self._asset.mesh.bounds[1] + self._asset.mesh.diagonal)
            # Last: who draws meanwhile sees either none or all of it, and sets the light anew.
            self._lit = False
            self._frames = frames

    def light(self, harmonics: NDArray[np.float64], turned: float) -> None:
        """The light of the next frames: [K,3], turned by so many degrees about the asset's up axis; [1,3] for an asset
        made for one light, which nothing turns.
        """
        self._light, self._turned, self._lit = harmonics, turned, False

    def draw(self, eye: ArrayLike) -> NDArray[np.float32]:
        """Radiance [V,3] to the eye [3]: as `Frames.draw` has it. The array is the same at every call."""
        if self._frames is None:
            return self._plain(np.asarray(eye, np.float64))
        from numba import get_num_threads, set_num_threads

        relit = not self._lit and self._asset.quantity == "transfer"
        if relit:
            self._frames.light(self._light)
            self._frames.turn(self._turned)
        self._lit = True
        # One thread for all but the largest objects, which takes it a millisecond: to wait for one more takes longer
        # where others, such as VTK's own, are at work.
        most = get_num_threads()
        set_num_threads(min(most, 1 + len(self._radiance) // _VERTICES_A_THREAD))
        try:
            self._hold_what_stays(self._frames, tuple(np.asarray(eye, np.float64).tolist()), relit)
            return self._frames.draw(eye)
        finally:
            set_num_threads(most)

    def _hold_what_stays(self, frames: "Frames", eye: tuple[float, ...], relit: bool) -> None:
        """Where the light has moved and the eye has not, it will go on so: interpolate between view bins once."""
        if relit and eye == self._drawn_for != self._held_for:
            frames.hold(eye)
            self._held_for = eye
        self._drawn_for = eye

    def _plain(self, eye: NDArray[np.float64]) -> NDArray[np.float32]:
        asset, light = self._asset, self._light
        if asset.quantity == "transfer":
            light = environment.rotate_light(light, self._turned, asset.up)
        for rows in _runs(np.flatnonzero(asset.valid)):
            outgoing = eye - asset.mesh.positions[rows]
            length = np.linalg.norm(outgoing, axis=1, keepdims=True)
            normals = asset.mesh.normals[rows]
            outgoing = np.where(length > 0.0, outgoing / np.where(length > 0.0, length, 1.0), normals)
            local = sphere.to_local(outgoing, normals, np.asarray(asset.tangents, np.float64)[rows])
            at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
            self._radiance[rows] = np.maximum(between(asset.coefficients, rows, at, asset.sectors, light), 0.0)
        return self._radiance


def between(
    coefficients: Any, rows: NDArray[np.int64], at: sphere.BinCoordinates, sectors: int, light: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Radiance [n,3], negative values kept, of vertices `rows` [n], as `reconstruction.reconstruct` has it."""

    def of(some: NDArray[np.int64], bins: Any) -> NDArray[np.float64]:
        return np.asarray((coefficients[some, bins] * light).sum(axis=-2))

    if coefficients.shape[1] == 1:
        return of(rows, 0)
    radiance = np.zeros((len(rows), 3))
    for ring, ring_share in ((at.ring_low, 1.0 - at.ring_weight), (at.ring_high, at.ring_weight)):
        for sector, sector_share in ((at.sector_low, 1.0 - at.sector_weight), (at.sector_high, at.sector_weight)):
            share = (1.0 - at.pole_weight) * ring_share * sector_share
            radiance += share[:, None] * of(rows, sectors * ring + sector)
    polar = np.flatnonzero(at.pole_weight > 0.0)
    for place in range(sectors if len(polar) else 0):
        radiance[polar] += at.pole_weight[polar, None] / sectors * of(rows[polar], place)
    return radiance


def _runs(rows: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for first in range(0, len(rows), _VERTICES_AT_ONCE):
        yield rows[first : first + _VERTICES_AT_ONCE]
