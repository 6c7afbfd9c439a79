"""Real-time drawing of an asset: radiance at its vertices for each frame, at memory bandwidth. Never loads torch."""

import math
from typing import Any

import numpy as np
from numba import get_num_threads
from numpy.typing import ArrayLike, NDArray

from formats.arguments import finite_number, flag
from formats.asset import Asset
from formats.asset.compact_record import CompactCoefficients
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.face.assets import asset as require_asset
from prt_bake.face.assets import light_of_vertices, warn_of_other_eye
from prt_bake.face.assets import point as require_point
from prt_bake.jit.threads import using_threads
from prt_bake.jit.vectors import laid_out
from prt_bake.lights.environment import rotate_light, rotation
from prt_bake.shading.asset_light import AssetLight, refuse_light_of_other_lobes
from prt_bake.shading.frames import codes, holding, kernels
from prt_bake.shading.frames.batches import GEOMETRY, LANE, make_scratch
from prt_bake.shading.frames.lobes import FrameLobes
from prt_bake.shading.vertices import light_coefficients

_FARTHEST = 1e100
_VERTICES_A_THREAD = 1 << 12
_CODED_A_THREAD = 1 << 9
"""Vertices that justify another thread; waiting for a thread on a busy machine costs milliseconds. Lobes are ten times
as much work, as are codes of a compact asset without a folded light or a held view.
"""
_NUMBERS_AT_ONCE = 1 << 24
_NEVER, _ALWAYS = -2.0, 2.0


class Frames:
    """Draws an asset many times: compiled, parallel, without allocations for a frame.

    Coefficients keep their storage: float32, float16 or compact. Each vertex also needs the mean of ring 0 and 40 bytes
    of geometry: position relative to the centre of the bounding box, normal and tangent as float32. Directions are
    computed in float64, sums in float32.

    Attributes:
        clamped: of the last frame, Σ of the negative radiance that was clamped to 0 / Σ of the radiance, over vertices
            and channels.

    >>> import prt_bake as prt
    >>> asset = prt.read_asset("spot.h5")
    >>> frames = prt.Frames(asset)
    >>> frames.light(prt.light_for(asset, prt.read_lighting("sky.hdr")))
    >>> radiance = frames.draw([0.0, 1.0, 4.0], cull=True)
    >>> radiance.shape == asset.mesh.positions.shape
    True
    """

    def __init__(self, asset: Asset) -> None:
        """Read an asset's coefficients into memory. Raises QueryError if no vertex is valid."""
        require_asset("asset", asset)
        if not asset.valid.any():
            raise QueryError(
                "asset: no vertex was baked, there is nothing to draw; bake it again (resume finishes a partial bake)"
            )
        self.clamped = 0.0
        self._asset = asset
        _, bins, self._terms, self._channels = asset.coefficients.shape
        self._grid = (asset.rings, asset.sectors) if bins > 1 else (1, 1)
        self._centre, geometry = _geometry(asset.mesh, asset.tangents)
        self._valid = asset.valid & np.isfinite(geometry).all(axis=1)
        self._scene = (_in_lanes(geometry), *self._marks())
        self._radiance = np.zeros((len(self._valid), 3), np.float32)
        self._eye = np.zeros(3)
        self._prepare_scratch()
        self._is_compact = isinstance(asset.coefficients, CompactCoefficients)
        if isinstance(asset.coefficients, CompactCoefficients):
            self._codes = codes.arrange(asset.coefficients, self._grid[1])
            self._views = np.zeros((get_num_threads(), self._codes.table.shape[1]), np.float32)
        else:
            self._stored = _flat_rows(asset.coefficients, self._grid[1])
        self._lobes = FrameLobes(asset.lobes, len(self._sums))
        self._light: NDArray[np.float64] | None = None
        self._rotations: NDArray[np.float64] | None = None
        self._light_waves: NDArray[np.float64] | None = None
        self._pairs: NDArray[np.float32] | None = None
        self._folded: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        self._held: NDArray[np.float32] | None = None
        self._held_view = self._eye.copy(), self._scene[1].copy(), False
        self._differs = np.zeros(len(self._scene[1]), np.bool_)
        self._held_shown = self._scene[-1].copy()
        if asset.quantity == "radiance":
            self.light(None)

    def __repr__(self) -> str:
        return f"Frames({len(self._valid)} vertices, {self._terms} coefficients, {len(self._asset.mesh.faces)} faces)"

    def light(self, light: AssetLight | ArrayLike | None) -> None:
        """Set the light of the next frames.

        Args:
            light: from `prt_bake.light_for`, whose lobes are shown and whose suns are not shaded apart; or coefficients
                [K,3] of the asset's degree; None for an asset made for one light.

        Undoes `fold`. Raises QueryError for another shape, and for numbers that float32 cannot represent.
        """
        light = light_of_vertices("light", light)
        prepared = light if isinstance(light, AssetLight) else AssetLight(light, whole=light)
        refuse_light_of_other_lobes(prepared, self._asset)
        coefficients = light_coefficients(self._asset, prepared.whole)
        if np.abs(coefficients).max() > np.finfo(np.float32).max:
            raise QueryError(f"light: expected coefficients within float32, found {np.abs(coefficients).max():.3g}")
        self._light, self._light_waves = coefficients, None
        self._lobes.set_light(prepared.lobes)
        self._load_light(coefficients)

    def turn(self, degrees: float) -> None:
        """Rotate the light that was set last by `degrees` about the asset's up axis, as `environment.rotate_light`.

        Angles do not add up between calls. Undoes `fold`. The coefficients of a rotated light are trigonometric
        polynomials in the angle, of the harmonics' degree, so that 2·degree + 1 rotations give all others. Raises
        QueryError for an asset made for one light, for an angle that is not finite, and if no light was set.
        """
        if self._asset.quantity == "radiance":
            raise QueryError("light: the asset was made for one light, which cannot be turned")
        degrees = finite_number("degrees", degrees)
        if self._light_waves is None:
            if self._rotations is None:
                self._rotations = _rotations(self._asset.degree, self._asset.up)
            self._light_waves = self._rotations @ self._required_light()
        self._load_light(np.tensordot(_fourier_terms(degrees, self._asset.degree), self._light_waves, 1))
        self._lobes.turn(rotation(degrees, self._asset.up))

    def fold(self) -> None:
        """Multiply the light into all coefficients once, for faster frames under the same light.

        A frame then reads one colour per bin instead of K, and the four bins around a view are adjacent in memory.
        Takes 24 bytes for each vertex and bin. Raises QueryError if no light was set.
        """
        self._required_light()
        if self._folded is not None:
            return
        vertices, bins = len(self._valid), math.prod(self._grid)
        if self._pairs is None:
            # Colours are read as four numbers.
            self._pairs = np.zeros(vertices * bins * 6 + 1, np.float32)
        compact = self._asset.coefficients
        with using_threads(len(self._sums)):
            if isinstance(compact, CompactCoefficients):
                for some, radiance in codes.radiance_at_bins(compact, self._flat_light.astype(np.float64)):
                    kernels.pair_up(radiance, self._grid, some, self._pairs)
            else:
                size = self._terms * self._channels
                kernels.fold_rows(self._stored[0], size, self._kernel_light, self._grid, self._valid, self._pairs)
        ring_0 = self._pairs[:-1].reshape(vertices, bins, 6)[:, : self._grid[1], :3]
        self._folded = self._pairs, ring_0.mean(axis=1, dtype=np.float64).astype(np.float32)

    def hold(self, eye: ArrayLike, visible: NDArray[np.bool_] | None = None, *, cull: bool = False) -> None:
        """Interpolate coefficients between the view bins once, for faster frames from the same eye under any light.

        A frame then reads one row of K colours per vertex, in order, also for compact assets. Takes 12 K bytes for each
        vertex. `draw` uses it for the same eye, vertices and culling. Raises as `draw`.
        """
        cull = flag("cull", cull)
        self._set_view(eye, visible)
        size = self._codes.size if self._is_compact else self._terms * self._channels
        if self._held is None:
            self._held = np.zeros(len(self._valid) * size, np.float32)
        with using_threads(self._threads(self._is_compact)) as threads:
            view = self._scene, self._eye, cull, self._grid, self._scratch
            if self._is_compact:
                holding.hold_compact(tuple(self._codes), *view, self._views, self._radiance, self._held, threads)
            else:
                holding.hold_rows(self._stored, size, *view, self._radiance, self._held, threads)
        self._held_view = self._eye.copy(), self._scene[1].copy(), cull
        self._held_shown = self._scene[-1].copy()

    def draw(
        self, eye: ArrayLike, visible: NDArray[np.bool_] | None = None, *, cull: bool = False
    ) -> NDArray[np.float32]:
        """Radiance [V,3] towards the eye, a point [3] in object space, as `prt_bake.shade`, clamped to at least 0.

        Args:
            eye: a point [3] in object space.
            visible: [V], the vertices to draw; the others and invalid ones are 0.
            cull: leaves out vertices whose faces all turn away from the eye; they are never visible on a closed object.

        Every call returns the same array.

        Raises QueryError for a mask of another shape or type, for an eye that is not a finite point, and if no light
        was set. An eye inside the object is not detected: directions below the horizon are clamped to it, and an eye on
        a vertex uses its normal.
        """
        cull = flag("cull", cull)
        self._required_light()
        self._set_view(eye, visible)
        held = self._held if self._holds(cull) else None
        coded = self._is_compact and held is None and self._folded is None
        with using_threads(self._threads(coded or self._lobes.lit)) as threads:
            sums = self._sums[threads - 1]
            sums[:] = 0.0
            self._draw(sums, cull, held)
        cut, kept = (float(sum(row[i] for row in sums)) for i in (0, 1))
        self.clamped = cut / kept if kept > 0.0 else float(cut > 0.0)
        return self._radiance

    def _set_view(self, eye: ArrayLike, visible: NDArray[np.bool_] | None) -> None:
        point = np.asarray(require_point("eye", eye), np.float64)
        if point.shape != (3,) or not (np.abs(point) < _FARTHEST).all():
            found = point.tolist() if point.shape == (3,) else f"shape {list(point.shape)}"
            raise QueryError(f"eye: expected a point of three finite numbers, found {found}")
        warn_of_other_eye(self._asset, point)
        np.subtract(point, self._centre, out=self._eye)
        self._request(visible)

    def _threads(self, coded: bool) -> int:
        """The number of threads that have enough work."""
        worth = int(np.count_nonzero(self._requested)) // (_CODED_A_THREAD if coded else _VERTICES_A_THREAD)
        return min(int(get_num_threads()), len(self._sums), 1 + worth)

    def _draw(self, sums: NDArray[np.float64], cull: bool, held: NDArray[np.float32] | None) -> None:
        view = self._scene, self._eye, cull, self._grid, self._scratch
        beyond = self._lobes.draw(self._scene, self._eye, cull, self._radiance, len(sums))
        if held is not None:
            width = len(held) // len(self._valid)
            np.copyto(self._scene[-1], self._held_shown)
            holding.draw_held(held, width, self._kernel_light, self._held_shown, self._radiance, beyond, sums)
        elif self._folded is not None:
            kernels.draw_folded(self._folded, *view, self._radiance, beyond, sums)
        elif self._is_compact:
            lights = self._kernel_light, self._flat_light
            kernels.draw_compact(tuple(self._codes), lights, *view, self._views, self._radiance, beyond, sums)
        else:
            size = self._terms * self._channels
            kernels.draw_rows(self._stored, size, self._kernel_light, *view, self._radiance, beyond, sums)

    def _holds(self, cull: bool) -> bool:
        if self._held is None:
            return False
        eye, requested, culled = self._held_view
        np.not_equal(requested, self._scene[1], out=self._differs)
        return cull == culled and np.array_equal(eye, self._eye) and not self._differs.any()

    def _required_light(self) -> NDArray[np.float64]:
        if self._light is None:
            raise QueryError("light: none was set; call `light` before `draw`, `fold` or `turn`")
        return self._light

    def _load_light(self, light: NDArray[np.float64]) -> None:
        """Bring a light into the layout of the kernels."""
        self._folded = None
        each = light if len(light) == self._terms else light.sum(axis=0, keepdims=True)
        compact = self._asset.coefficients
        if isinstance(compact, CompactCoefficients):
            channels = np.broadcast_to(compact.channels.astype(np.float64), (*compact.channels.shape[:2], 3))
            basis_light = np.zeros((self._codes.size, 3))
            basis_light[: len(channels)] = compact.step * np.einsum("jkc,kc->jc", channels, each)
            self._flat_light = basis_light.astype(np.float32)
        else:
            by_channel = np.ones((1, 3)) if self._channels == 1 else np.eye(3)
            self._flat_light = (each[:, None] * by_channel).reshape(-1, 3).astype(np.float32)
        self._kernel_light = laid_out(self._flat_light)

    def _marks(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Flags of requested and shown vertices: as lanes, and one by one."""
        requested, shown = (np.zeros(LANE * -(-len(self._valid) // LANE), np.bool_) for _ in range(2))
        self._requested = requested[: len(self._valid)]
        return requested.view(np.uint64), shown.view(np.uint64), requested, shown

    def _request(self, visible: NDArray[np.bool_] | None) -> None:
        if visible is None:
            np.copyto(self._requested, self._valid)
            return
        if getattr(visible, "dtype", None) != np.bool_ or visible.shape != self._valid.shape:
            found = f"{list(np.shape(visible))} of {getattr(visible, 'dtype', type(visible).__name__)}"
            raise QueryError(f"visible: expected [{len(self._valid)}] of bool, found {found}")
        np.logical_and(visible, self._valid, out=self._requested)

    def _prepare_scratch(self) -> None:
        """Working memory of each thread; `_sums[n - 1]` is for n threads."""
        threads = int(get_num_threads())
        self._scratch = make_scratch(threads)
        sums = np.zeros((threads, 8))
        self._sums = [sums[:n] for n in range(1, threads + 1)]


def _flat_rows(coefficients: Any, sectors: int) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Coefficients [V,B,K,C] in their storage, flat, and their means over ring 0, flat."""
    inside = np.ascontiguousarray(coefficients)
    means = np.empty((len(inside), *inside.shape[2:]), np.float32)
    step = max(1, _NUMBERS_AT_ONCE // max(1, sectors * math.prod(inside.shape[2:])))
    for first in range(0, len(inside), step):
        means[first : first + step] = inside[first : first + step, :sectors].mean(axis=1, dtype=np.float64)
    flat = inside.reshape(-1)
    return flat.view(np.uint16) if flat.dtype == np.float16 else flat, means.reshape(-1)


def _geometry(mesh: Mesh, tangents: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """The centre of the bounding box [3], and the geometry of vertices [V,10].

    A row holds the position relative to the centre, normal, tangent, and the cosine of the direction to the eye below
    which all faces of the vertex turn away. These are the directions at least 90° + α from its normal, where α is the
    largest angle between the vertex normal and the normal of one of its faces.
    """
    low, high = mesh.bounds
    centre = (low + high) / 2.0
    nearest = np.full(len(mesh.positions), np.inf)
    for corner in mesh.faces.T:
        np.minimum.at(nearest, corner, (mesh.face_normals * mesh.normals[corner]).sum(axis=1))
    # A margin for the rounding of normals.
    limit = -np.sqrt(1.0 - np.clip(nearest, 0.0, 1.0) ** 2) - 1e-5
    limit = np.where(nearest > 0.0, limit, _NEVER)
    limit[np.isinf(nearest)] = _ALWAYS
    geometry = np.empty((len(mesh.positions), GEOMETRY), np.float32)
    geometry[:, :3], geometry[:, 3:6], geometry[:, 6:9] = mesh.positions - centre, mesh.normals, tangents
    geometry[:, 9] = limit
    return centre, geometry


def _in_lanes(geometry: NDArray[np.float32]) -> NDArray[np.float32]:
    """Lanes of eight vertices [lanes,10,8]; 0 for numbers that are not finite, and after the last vertex."""
    lanes = -(-len(geometry) // LANE)
    padded = np.zeros((lanes * LANE, GEOMETRY), np.float32)
    np.copyto(padded[: len(geometry)], geometry, where=np.isfinite(geometry))
    return np.ascontiguousarray(padded.reshape(lanes, LANE, GEOMETRY).transpose(0, 2, 1))


def _fourier_terms(degrees: float, degree: int) -> NDArray[np.float64]:
    """1, cos mα and sin mα [2·degree + 1]."""
    angles = np.arange(1, degree + 1) * math.radians(degrees % 360.0)
    return np.concatenate([[1.0], np.cos(angles), np.sin(angles)])


def _rotations(degree: int, up: str) -> NDArray[np.float64]:
    """The matrices [2·degree + 1, K, K] whose sum, weighted by `_fourier_terms`, rotates a light's coefficients."""
    angles = 360.0 * np.arange(2 * degree + 1) / (2 * degree + 1)
    turned = np.stack([rotate_light(np.eye((degree + 1) ** 2), angle, up) for angle in angles])
    waves = np.stack([_fourier_terms(angle, degree) for angle in angles])
    return np.asarray(np.tensordot(np.linalg.inv(waves), turned, 1))
