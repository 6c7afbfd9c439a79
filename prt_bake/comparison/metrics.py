"""Metrics of a picture against its reference: MSE, relative MSE, SSIM, FLIP and HDR-FLIP.

MSE uses linear radiance. SSIM and FLIP use display-referred pictures: the sRGB curve, clamped to [0,1]. HDR-FLIP uses
linear radiance at a range of exposures (`prt_bake.comparison.flip`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError, refuse_path
from formats.image.png import to_srgb
from formats.summary import summary
from prt_bake.comparison.flip import (
    Exposures,
    evaluate_extra,
    exposures_between,
    flip_map,
    hdr_flip_map,
    paper_exposures,
)

Array = NDArray[np.float64]

Names = tuple[str, str, str]
NAMES: Names = ("the image", "the reference", "the mask")
RELATIVE_FLOOR = 1e-2
_SSIM_WINDOW = 11
_MAX_STOPS = 100.0


@dataclass(frozen=True)
class Comparison:
    """Metrics over the pixels of the mask (all pixels without a mask).

    Attributes:
        mse: mean squared difference of linear radiance, after exposure.
        relative_mse: mean of squared difference / (reference² + 0.01²), as pbrt's MRSE.
        relative_rmse: sqrt(Σ squared difference / Σ reference²); nan for a black reference.
        ssim: structural similarity (Wang et al. 2004: Gaussian window, sigma 1.5), the mean over channels; 1 is equal,
            nan for pictures smaller than the window of 11 pixels.
        ssim_quarter: SSIM of the pictures' means over 4×4 pixels, which favours blur over noise less than SSIM does.
        flip: mean FLIP (Andersson et al. 2020) at 67 pixels per degree; 0 is equal, 1 the worst.
        flip_map: FLIP [H,W] of all pixels, inside and outside the mask.
        hdr_flip, hdr_exposures, hdr_flip_map: mean HDR-FLIP, its exposures and its map; None unless requested.
    """

    mse: float
    relative_mse: float
    relative_rmse: float
    ssim: float
    ssim_quarter: float
    flip: float
    flip_map: NDArray[np.float32]
    hdr_flip: float | None = None
    hdr_exposures: Exposures | None = None
    hdr_flip_map: NDArray[np.float32] | None = None

    def as_json(self) -> dict[str, Any]:
        """The metrics without the maps."""
        names = ("mse", "relative_mse", "relative_rmse", "ssim", "ssim_quarter", "flip")
        figures: dict[str, Any] = {name: getattr(self, name) for name in names}
        if self.hdr_exposures is not None:
            figures |= {"hdr_flip": self.hdr_flip, "hdr_exposures": self.hdr_exposures._asdict()}
        return figures

    __repr__ = summary


def compare(
    image: ArrayLike,
    reference: ArrayLike,
    mask: ArrayLike | None = None,
    exposure: float = 0.0,
    *,
    hdr: bool | tuple[float, float] = False,
    names: Names = NAMES,
) -> Comparison:
    """Compare linear pictures [H,W,3], both multiplied by 2^exposure first.

    Args:
        image: the picture.
        reference: the picture it is compared with.
        mask: [H,W] or [H,W,3], of booleans, weights, or 8 or 16 bits; pixels count if the mean of its channels is above
            half of white. Windows of SSIM and FLIP extend beyond the mask.
        exposure: in stops.
        hdr: True computes HDR-FLIP over the exposures of its paper; a pair gives the first and last exposure in stops,
            in addition to `exposure`.
        names: what messages call the picture, the reference and the mask; three texts.

    Raises QueryError for shapes that do not match, for a mask without pixels, and for pixels or exposures out of their
    domain. Raises PrtbakeError if the extra `evaluate` is not installed.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> reference = np.full((16, 16, 3), 0.5)
    >>> found = prt.compare(1.1 * reference, reference)
    >>> round(found.mse, 6), round(found.relative_rmse, 6)
    (0.0025, 0.1)
    """
    linear, linear_reference, chosen = checked(image, reference, mask, exposure, names)
    squared = (linear - linear_reference) ** 2
    signal = float((linear_reference[chosen] ** 2).sum())
    srgb, srgb_reference = to_srgb(linear), to_srgb(linear_reference)
    flip = flip_map(srgb, srgb_reference)
    exposures = None if hdr is False else paper_exposures(linear_reference) if hdr is True else exposures_between(*hdr)
    hdr_flip = None if exposures is None else hdr_flip_map(linear, linear_reference, exposures)
    return Comparison(
        mse=float(squared[chosen].mean()),
        relative_mse=float((squared / (linear_reference**2 + RELATIVE_FLOOR**2))[chosen].mean()),
        relative_rmse=float(np.sqrt(squared[chosen].sum() / signal)) if signal > 0.0 else float("nan"),
        ssim=_mean(ssim_map(srgb, srgb_reference), chosen),
        ssim_quarter=_mean(ssim_map(quartered(srgb), quartered(srgb_reference)), quarter_mask(chosen)),
        flip=_mean(flip, chosen),
        flip_map=flip,
        hdr_flip=None if hdr_flip is None else _mean(hdr_flip, chosen),
        hdr_exposures=exposures,
        hdr_flip_map=hdr_flip,
    )


def checked(
    image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None, exposure: float, names: Names = NAMES
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Both pictures [H,W,3] times 2^exposure, and the mask [H,W]. Raises QueryError as `compare`."""
    if not abs(exposure) <= _MAX_STOPS:
        raise QueryError(f"compare: expected an exposure within ±{_MAX_STOPS:g} stops, found {exposure:g}")
    linear, linear_reference = (
        _picture(part, name) * 2.0**exposure for part, name in zip((image, reference), names[:2], strict=True)
    )
    if linear.shape != linear_reference.shape:
        raise QueryError(
            f"compare: {names[0]} is {_size(linear)}, {names[1]} {_size(linear_reference)}; both must be of one size"
        )
    chosen = np.ones(linear.shape[:2], np.bool_) if mask is None else _chosen(mask, linear, names[2])
    return linear, linear_reference, chosen


def ssim_map(image: Array, reference: Array) -> Array:
    """SSIM [H,W] of sRGB pictures [H,W,3], the mean over channels; nan for pictures smaller than its window."""
    if min(image.shape[:2]) < _SSIM_WINDOW:
        return np.full(image.shape[:2], np.nan)
    _mean, similarity = evaluate_extra("skimage.metrics").structural_similarity(
        image,
        reference,
        channel_axis=2,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return np.asarray(similarity.mean(axis=2))


def quartered(image: Array) -> Array:
    """Means over blocks of 4×4 pixels [H/4,W/4,3]; incomplete blocks are left out."""
    h, w = image.shape[0] // 4, image.shape[1] // 4
    return np.asarray(image[: 4 * h, : 4 * w].reshape(h, 4, w, 4, image.shape[2]).mean(axis=(1, 3)))


def quarter_mask(chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The blocks of 4×4 pixels with more than half of their pixels in the mask."""
    return np.asarray(quartered(chosen[..., None].astype(np.float64))[..., 0] > 0.5)


def _picture(image: ArrayLike, name: str) -> Array:
    refuse_path(name, image, "prt.read_image")
    pixels = np.asarray(image, np.float64)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise QueryError(f"compare: expected {name} of shape [H, W, 3], found {list(pixels.shape)}")
    wrong = np.argwhere(~np.isfinite(pixels).all(axis=2))
    if len(wrong):
        row, column = wrong[0].tolist()
        raise QueryError(
            f"compare: {len(wrong)} of {pixels[..., 0].size} pixels of {name} are not finite, the first at row "
            f"{row}, column {column}; render it again or repair it"
        )
    return pixels


def _chosen(mask: ArrayLike, image: Array, name: str) -> NDArray[np.bool_]:
    values = np.asarray(mask, np.float64)
    values = values.mean(axis=2) if values.shape[2:] in ((1,), (3,)) else values
    if values.shape != image.shape[:2]:
        raise QueryError(
            f"compare: expected {name} of the pictures' shape {list(image.shape[:2])}, found {list(values.shape)}"
        )
    if np.isnan(values).any():
        raise QueryError(f"compare: {name} is NaN at {np.isnan(values).sum()} of {values.size} pixels; repair it")
    chosen = values > 0.5
    if not chosen.any():
        raise QueryError(f"compare: {name} chooses no pixel; chosen pixels are white, above 0.5")
    return np.asarray(chosen)


def _size(image: Array) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _mean(values: NDArray[np.floating], chosen: NDArray[np.bool_]) -> float:
    return float(values[chosen].mean(dtype=np.float64)) if chosen.any() else float("nan")
