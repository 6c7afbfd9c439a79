"""Errors of the engine form compared with its asset: of coefficients, and of radiance under lights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.export.engine_form import (
    HIGHEST_DEGREE,
    EngineForm,
    blocks,
    frame_rotations,
    view_basis,
    view_fit,
)
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.vertices import eye_directions, light_coefficients

Array = NDArray[np.float64]

_EYES = np.concatenate([np.eye(3), -np.eye(3)])
_EYE_DISTANCE = 4.0
"""Of the six eyes from the centre of the object, in its bounding radius."""
_SUNS = np.array([[0.6, 0.64, 0.48], [-0.48, 0.6, -0.64], [0.64, -0.48, 0.6]])


@dataclass(frozen=True)
class FormError:
    """Relative RMSE of an engine form compared with its asset.

    Attributes:
        coefficients: over valid vertices, view bins, harmonics and channels; of radiance for one light.
        coefficients_95: 95th percentile over vertices of the same ratio of each vertex.
        radiance_median, radiance_worst: of the radiance of the vertices that face the eye, over six eyes, and over the
            light of the form, or a sky and three suns.
    """

    coefficients: float
    coefficients_95: float
    radiance_median: float
    radiance_worst: float


def form_error(asset: Asset, form: EngineForm, sky: Array, light: ArrayLike | None = None) -> FormError:
    """Compare an engine form with its asset. sky [K,3]: one of the lights; `light`: what was folded into the form."""
    weights = None if light is None else light_coefficients(asset, light)
    lights = _lights(form, sky)
    outgoing = [_towards(asset, eye) for eye in _EYES]
    squares, norms = np.zeros((2, len(asset.valid)))
    of_radiance, radiance = np.zeros((2, len(_EYES), len(lights)))
    basis = view_basis(asset, form.view_degree)
    for part, block in blocks(asset, weights):
        local = np.matmul(frame_rotations(asset, part, form.view_degree), _rows(form.coefficients[part]))
        squares[part] = ((np.matmul(basis, local) - _rows(block)) ** 2).sum(axis=(1, 2))
        norms[part] = (_rows(block).astype(np.float64) ** 2).sum(axis=(1, 2))
        for e, towards in enumerate(outgoing):
            facing = np.flatnonzero((towards[part] * asset.mesh.normals[part]).sum(axis=1) > 0.0)
            for i, each in enumerate(lights):
                true = np.maximum(_of_block(asset, block, part, facing, towards[part][facing], each), 0.0)
                found = np.maximum(form.radiance(facing + part.start, towards[part][facing], each), 0.0)
                of_radiance[e, i] += ((found - true) ** 2).sum()
                radiance[e, i] += (true**2).sum()
    ratios = np.sqrt(of_radiance[radiance > 0.0] / radiance[radiance > 0.0])
    lit = norms > 0.0
    each = np.sqrt(squares[lit] / norms[lit])
    return FormError(
        float(np.sqrt(squares.sum() / norms.sum())) if len(each) else 0.0,
        float(np.percentile(each, 95)) if len(each) else 0.0,
        float(np.median(ratios)) if len(ratios) else 0.0,
        float(ratios.max()) if len(ratios) else 0.0,
    )


def errors_by_degree(asset: Asset, light: ArrayLike | None = None) -> Array:
    """Relative RMSE of the coefficients [n] of forms of degree 0, 1, … 8, before they are stored."""
    weights = None if light is None else light_coefficients(asset, light)
    degrees = 1 if asset.coefficients.shape[1] == 1 else HIGHEST_DEGREE + 1
    fits = [(view_basis(asset, n).astype(np.float32), view_fit(asset, n).astype(np.float32)) for n in range(degrees)]
    squares, norm = np.zeros(degrees), 0.0
    for _, block in blocks(asset, weights):
        values = _rows(block)
        norm += float((values.astype(np.float64) ** 2).sum())
        for degree, (basis, fit) in enumerate(fits):
            difference = np.matmul(basis, np.matmul(fit, values)) - values
            squares[degree] += (difference.astype(np.float64) ** 2).sum()
    return np.asarray(np.sqrt(squares / (norm or 1.0)))


def degrees_for(asset: Asset, error: float, light: ArrayLike | None = None) -> range:
    """The degrees of the view from the least one on whose coefficients are within `error`, before they are stored.

    Raises QueryError if `error` is not between 0 and 1, or if no degree up to 8 suffices.
    """
    if not 0.0 < error < 1.0:
        raise QueryError(f"error: expected a number between 0 and 1, found {error:g}")
    errors = errors_by_degree(asset, light)
    if not (errors <= error).any():
        raise QueryError(
            f"error: harmonics of the view of degree {len(errors) - 1} leave {errors[-1]:.3g}, expected {error:g} or "
            f"less; give a larger error, or use the asset itself, which has view bins"
        )
    return range(int(np.argmax(errors <= error)), len(errors))


def _lights(form: EngineForm, sky: Array) -> list[Array]:
    if form.quantity == "radiance":
        return [np.ones((1, 3))]
    suns = sh.evaluate(_SUNS, form.light_degree)
    return [sky, *(np.repeat(sun[:, None], 3, axis=1) for sun in suns)]


def _towards(asset: Asset, eye: Array) -> Array:
    """Unit directions [V,3] to an eye in the direction `eye` from the centre of the object."""
    low, high = asset.mesh.positions.min(axis=0), asset.mesh.positions.max(axis=0)
    centre, radius = (low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0
    return eye_directions(asset, centre + _EYE_DISTANCE * radius * eye, np.arange(len(asset.valid)))


def _of_block(
    asset: Asset, block: NDArray[np.float32], part: slice, rows: NDArray[np.int64], outgoing: Array, light: Array
) -> Array:
    """Radiance [n,3] of rows of a block by its view bins."""
    local = sphere.to_local(
        outgoing, asset.mesh.normals[part][rows], np.asarray(asset.tangents, np.float64)[part][rows]
    )
    at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    return reconstruct(block, rows, at, asset.sectors, light)


def _rows(coefficients: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n,B,K,3] as [n,B,3K]."""
    return coefficients.reshape(*coefficients.shape[:2], -1)
