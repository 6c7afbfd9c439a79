"""Drawing an asset many times: radiance at its vertices, a frame at a time, at the speed of memory; without torch."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numba import get_num_threads, set_num_threads
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.asset.compact_record import CompactCoefficients
from formats.errors import QueryError, refuse_path
from formats.mesh import Mesh
from prt_bake.jit.vectors import laid_out
from prt_bake.lights.environment import rotate_light
from prt_bake.shading.frames import codes, holding, kernels
from prt_bake.shading.frames.batches import BATCH, GEOMETRY, LANE
from prt_bake.shading.vertices import light_of

_FARTHEST = 1e100
_VERTICES_A_THREAD = 1 << 12
_CODED_A_THREAD = 1 << 9
"""So many are worth waking a thread for: on a busy machine waiting for one more costs milliseconds. Codes of a compact
asset, where neither light is folded in nor a view held, are ten times as much work.
"""
_NUMBERS_AT_ONCE = 1 << 24
_NEVER, _ALWAYS = -2.0, 2.0


class Frames:
    """An asset ready to be drawn many times: compiled, parallel, no allocation a frame.

    Coefficients stay in memory as they lie, float32, the bits of float16, or compact; beside them stand the mean of
    ring 0 at each vertex and 40 bytes of geometry: position about the centre of the bounding box, normal and tangent
    as float32, as files keep them. Directions are worked out in float64, sums in float32.

    clamped: of the last frame, Σ of what was cut off / Σ of what is left, over vertices and channels.
    """

    def __init__(self, asset: Asset) -> None:
        """Read an asset's coefficients into memory where they are not. Raises QueryError where no vertex is valid."""
        refuse_path("asset", asset, "prt.read_asset")
        if not asset.valid.any():
            raise QueryError(
                "asset: no vertex was baked, there is nothing to draw; bake it again (--resume finishes a partial bake)"
            )
        self.clamped = 0.0
        self._asset = asset
        _, bins, self._terms, self._channels = asset.coefficients.shape
        self._grid = (asset.rings, asset.sectors) if bins > 1 else (1, 1)
        self._centre, geometry = _geometry(asset.mesh, asset.tangents)
        self._valid = asset.valid & np.isfinite(geometry).all(axis=1)
        self._scene = (_side_by_side(geometry), *self._marks())
        self._radiance = np.zeros((len(self._valid), 3), np.float32)
        self._eye = np.zeros(3)
        self._prepare_desks()
        self._is_compact = isinstance(asset.coefficients, CompactCoefficients)
        if isinstance(asset.coefficients, CompactCoefficients):
            self._codes = codes.arranged(asset.coefficients, self._grid[1])
            self._views = np.zeros((get_num_threads(), self._codes.table.shape[1]), np.float32)
        else:
            self._stored = _rows(asset.coefficients, self._grid[1])
        self._light: NDArray[np.float64] | None = None
        self._turns: NDArray[np.float64] | None = None
        self._waves: NDArray[np.float64] | None = None
        self._pairs: NDArray[np.float32] | None = None
        self._folded: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        self._held: NDArray[np.float32] | None = None
        self._held_for = self._eye.copy(), self._scene[1].copy(), False
        self._differs = np.zeros(len(self._scene[1]), np.bool_)
        self._held_shown = self._scene[-1].copy()
        if asset.quantity == "radiance":
            self.light(None)

    def light(self, coefficients: ArrayLike | None) -> None:
        """The light of the next frames: [K,3] of the asset's degree, None for an asset made for one light (quantity
        "radiance"). Undoes `fold`. Raises QueryError for another shape, and for numbers that float32 cannot hold.
        """
        light = light_of(self._asset, coefficients)
        if np.abs(light).max() > np.finfo(np.float32).max:
            raise QueryError(f"light: a coefficient of {np.abs(light).max():.3g} where float32 is expected to hold it")
        self._light, self._waves = light, None
        self._shine(light)

    def turn(self, degrees: float) -> None:
        """Turn the light that was set last by `degrees` in all about the asset's up axis, counter-clockwise seen from
        above, as `environment.rotate_light` does. Undoes `fold`.

        Coefficients of a light that turns are trigonometric polynomials in the angle of the harmonics' degree: 2·degree
        + 1 of its turns give all others. Raises QueryError for an asset made for one light, for an angle that is not
        finite, and before a light was set.
        """
        if self._asset.quantity == "radiance":
            raise QueryError("light: the asset was made for one light and cannot be turned under it")
        if not math.isfinite(degrees):
            raise QueryError(f"degrees: {degrees} where a finite number is expected")
        if self._waves is None:
            if self._turns is None:
                self._turns = _turns(self._asset.degree, self._asset.up)
            self._waves = self._turns @ self._lit()
        self._shine(np.tensordot(_wave(degrees, self._asset.degree), self._waves, 1))

    def fold(self) -> None:
        """Multiply the light into all coefficients, once: while it stays, a frame reads one colour a bin instead of K,
        and what lies between four bins from one place in memory. Takes 24 bytes for each vertex and bin.

        Raises QueryError before a light was set.
        """
        self._lit()
        if self._folded is not None:
            return
        vertices, bins = len(self._valid), math.prod(self._grid)
        if self._pairs is None:
            # Colours are read four numbers at a time.
            self._pairs = np.zeros(vertices * bins * 6 + 1, np.float32)
        compact = self._asset.coefficients
        if isinstance(compact, CompactCoefficients):
            for some, radiance in codes.under_light(compact, self._plain.astype(np.float64)):
                kernels.pair_up(radiance, self._grid, some, self._pairs)
        else:
            size = self._terms * self._channels
            kernels.fold_rows(self._stored[0], size, self._laid, self._grid, self._valid, self._pairs)
        ring_0 = self._pairs[:-1].reshape(vertices, bins, 6)[:, : self._grid[1], :3]
        self._folded = self._pairs, ring_0.mean(axis=1, dtype=np.float64).astype(np.float32)

    def hold(self, eye: ArrayLike, visible: NDArray[np.bool_] | None = None, *, cull: bool = False) -> None:
        """Interpolate what is stored between the view bins, once: while the eye stays, a frame under any light reads
        one row of K colours a vertex, in order, compact assets as others. Takes 12 K bytes for each vertex.

        `draw` makes use of it where it is asked for the same eye, vertices and culling. Raises as `draw` does.
        """
        self._look(eye, visible)
        size = self._codes.size if self._is_compact else self._terms * self._channels
        if self._held is None:
            self._held = np.zeros(len(self._valid) * size, np.float32)
        with _running_on(self._threads(self._is_compact)) as threads:
            view = self._scene, self._eye, bool(cull), self._grid, self._desks
            if self._is_compact:
                holding.hold_compact(tuple(self._codes), *view, self._views, self._radiance, self._held, threads)
            else:
                holding.hold_rows(self._stored, size, *view, self._radiance, self._held, threads)
        self._held_for = self._eye.copy(), self._scene[1].copy(), bool(cull)
        self._held_shown = self._scene[-1].copy()

    def draw(
        self, eye: ArrayLike, visible: NDArray[np.bool_] | None = None, *, cull: bool = False
    ) -> NDArray[np.float32]:
        """Radiance [V,3] towards the eye, a point [3] in object space, as `shading.shade` has it: negative values are
        cut to 0, vertices that are not valid or not asked for hold 0. The array is the same at every call.

        visible: the vertices to draw. With `cull` those of them are left out, and not read, all of whose faces turn
        away from the eye: of a closed object they are never seen. Raises QueryError for a mask of another shape or
        type, for an eye that is no finite point, and before a light was set. Whether the eye is inside the object is
        not looked at: there directions below the horizon are taken as grazing, and on a vertex its normal.
        """
        self._lit()
        self._look(eye, visible)
        held = self._held if self._holds(bool(cull)) else None
        with _running_on(self._threads(self._is_compact and held is None and self._folded is None)) as threads:
            sums = self._sums[threads - 1]
            sums[:] = 0.0
            self._draw(sums, bool(cull), held)
        cut, kept = (float(sum(row[i] for row in sums)) for i in (0, 1))
        self.clamped = cut / kept if kept > 0.0 else float(cut > 0.0)
        return self._radiance

    def _look(self, eye: ArrayLike, visible: NDArray[np.bool_] | None) -> None:
        place = np.asarray(eye, np.float64)
        if place.shape != (3,) or not (np.abs(place) < _FARTHEST).all():
            raise QueryError(f"eye: {np.asarray(eye).tolist()} where a point of three finite numbers is expected")
        np.subtract(place, self._centre, out=self._eye)
        self._ask(visible)

    def _threads(self, coded: bool) -> int:
        """How many threads are worth waking, where codes are read and where not."""
        worth = int(np.count_nonzero(self._asked)) // (_CODED_A_THREAD if coded else _VERTICES_A_THREAD)
        return min(int(get_num_threads()), len(self._sums), 1 + worth)

    def _draw(self, sums: NDArray[np.float64], cull: bool, held: NDArray[np.float32] | None) -> None:
        view = self._scene, self._eye, cull, self._grid, self._desks
        if held is not None:
            width = len(held) // len(self._valid)
            np.copyto(self._scene[-1], self._held_shown)
            holding.draw_held(held, width, self._laid, self._held_shown, self._radiance, sums)
        elif self._folded is not None:
            kernels.draw_folded(self._folded, *view, self._radiance, sums)
        elif self._is_compact:
            lights = self._laid, self._plain
            kernels.draw_compact(tuple(self._codes), lights, *view, self._views, self._radiance, sums)
        else:
            size = self._terms * self._channels
            kernels.draw_rows(self._stored, size, self._laid, *view, self._radiance, sums)

    def _holds(self, cull: bool) -> bool:
        if self._held is None:
            return False
        eye, asked, culled = self._held_for
        np.not_equal(asked, self._scene[1], out=self._differs)
        return cull == culled and np.array_equal(eye, self._eye) and not self._differs.any()

    def _lit(self) -> NDArray[np.float64]:
        if self._light is None:
            raise QueryError("light: none was set; set one before drawing, folding or turning it")
        return self._light

    def _shine(self, light: NDArray[np.float64]) -> None:
        """Lay a light out as the kernels read it."""
        self._folded = None
        each = light if len(light) == self._terms else light.sum(axis=0, keepdims=True)
        compact = self._asset.coefficients
        if isinstance(compact, CompactCoefficients):
            channels = np.broadcast_to(compact.channels.astype(np.float64), (*compact.channels.shape[:2], 3))
            lit = np.zeros((self._codes.size, 3))
            lit[: len(channels)] = compact.step * np.einsum("jkc,kc->jc", channels, each)
            self._plain = lit.astype(np.float32)
        else:
            by_channel = np.ones((1, 3)) if self._channels == 1 else np.eye(3)
            self._plain = (each[:, None] * by_channel).reshape(-1, 3).astype(np.float32)
        self._laid = laid_out(self._plain)

    def _marks(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Which vertices are asked for, which are shown: as lanes, and one by one."""
        asked, shown = (np.zeros(LANE * -(-len(self._valid) // LANE), np.bool_) for _ in range(2))
        self._asked = asked[: len(self._valid)]
        return asked.view(np.uint64), shown.view(np.uint64), asked, shown

    def _ask(self, visible: NDArray[np.bool_] | None) -> None:
        if visible is None:
            np.copyto(self._asked, self._valid)
            return
        if getattr(visible, "dtype", None) != np.bool_ or visible.shape != self._valid.shape:
            found = f"{list(np.shape(visible))} of {getattr(visible, 'dtype', type(visible).__name__)}"
            raise QueryError(f"visible: {found} where [{len(self._valid)}] of bool is expected")
        np.logical_and(visible, self._valid, out=self._asked)

    def _prepare_desks(self) -> None:
        """What each thread works with; `_sums[n - 1]` is for n threads."""
        threads = int(get_num_threads())
        weights = np.zeros((threads, 5, BATCH), np.float32)
        weights[:, 0] = 1.0
        self._desks = (
            np.zeros((threads, BATCH), np.int64),
            np.zeros((threads, 3, BATCH)),
            np.zeros((threads, 4, BATCH), np.int32),
            weights,
        )
        sums = np.zeros((threads, 8))
        self._sums = [sums[:n] for n in range(1, threads + 1)]


@contextmanager
def _running_on(count: int) -> Iterator[int]:
    """Kernels run on so many threads."""
    most = int(get_num_threads())
    set_num_threads(count)
    try:
        yield count
    finally:
        set_num_threads(most)


def _rows(coefficients: Any, sectors: int) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Coefficients [V,B,K,C] as they lie, flat, and their means over ring 0, flat."""
    inside = np.ascontiguousarray(coefficients)
    means = np.empty((len(inside), *inside.shape[2:]), np.float32)
    step = max(1, _NUMBERS_AT_ONCE // max(1, sectors * math.prod(inside.shape[2:])))
    for first in range(0, len(inside), step):
        means[first : first + step] = inside[first : first + step, :sectors].mean(axis=1, dtype=np.float64)
    flat = inside.reshape(-1)
    return flat.view(np.uint16) if flat.dtype == np.float16 else flat, means.reshape(-1)


def _geometry(mesh: Mesh, tangents: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """The centre of the bounding box [3]; position about it, normal, tangent, and the cosine of the direction to the
    eye below which all faces about a vertex turn away [V,10].

    All about a vertex turn away from directions at least 90° + α from its normal, α the largest angle between it and
    the normal of a face.
    """
    low, high = mesh.bounds
    centre = (low + high) / 2.0
    nearest = np.full(len(mesh.positions), np.inf)
    for corner in mesh.faces.T:
        np.minimum.at(nearest, corner, (mesh.face_normals * mesh.normals[corner]).sum(axis=1))
    # A little less, for the rounding of normals.
    limit = -np.sqrt(1.0 - np.clip(nearest, 0.0, 1.0) ** 2) - 1e-5
    limit = np.where(nearest > 0.0, limit, _NEVER)
    limit[np.isinf(nearest)] = _ALWAYS
    geometry = np.empty((len(mesh.positions), GEOMETRY), np.float32)
    geometry[:, :3], geometry[:, 3:6], geometry[:, 6:9] = mesh.positions - centre, mesh.normals, tangents
    geometry[:, 9] = limit
    return centre, geometry


def _side_by_side(geometry: NDArray[np.float32]) -> NDArray[np.float32]:
    """Eight vertices to a lane [lanes,10,8]; zeros for what is not finite, and behind the last vertex."""
    lanes = -(-len(geometry) // LANE)
    each = np.zeros((lanes * LANE, GEOMETRY), np.float32)
    np.copyto(each[: len(geometry)], geometry, where=np.isfinite(geometry))
    return np.ascontiguousarray(each.reshape(lanes, LANE, GEOMETRY).transpose(0, 2, 1))


def _wave(degrees: float, degree: int) -> NDArray[np.float64]:
    """1, cos mα and sin mα [2·degree + 1]."""
    angles = np.arange(1, degree + 1) * math.radians(degrees % 360.0)
    return np.concatenate([[1.0], np.cos(angles), np.sin(angles)])


def _turns(degree: int, up: str) -> NDArray[np.float64]:
    """What each number of `_wave` does to a light's coefficients [2·degree + 1, K, K]."""
    angles = 360.0 * np.arange(2 * degree + 1) / (2 * degree + 1)
    turned = np.stack([rotate_light(np.eye((degree + 1) ** 2), angle, up) for angle in angles])
    waves = np.stack([_wave(angle, degree) for angle in angles])
    return np.asarray(np.tensordot(np.linalg.inv(waves), turned, 1))
