"""How far a picture is from its reference: MSE, relative MSE, SSIM and FLIP.

MSE is over linear radiance. SSIM and FLIP are over the pictures as they are shown: the sRGB curve, cut to [0,1].
"""

from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import PrtbakeError, QueryError

Array = NDArray[np.float64]

PIXELS_PER_DEGREE = 67.0
_RELATIVE_FLOOR = 1e-2
_SSIM_WINDOW = 11
_MOST_STOPS = 100.0


@dataclass(frozen=True)
class Comparison:
    """Figures over the pixels of the mask (all without one).

    Attributes:
        mse: mean squared difference of linear radiance, after exposure.
        relative_mse: the mean of squared difference / (reference² + 0.01²), as pbrt's MRSE damps dark pixels.
        ssim: structural similarity (Wang et al. 2004: Gaussian window, sigma 1.5), the mean over channels; 1 is equal,
            nan for pictures smaller than its window of 11 pixels.
        ssim_quarter: the same of the pictures' means over 4×4 pixels; SSIM prefers blur to noise, this one less so.
        flip: mean FLIP (Andersson et al. 2020) at 67 pixels a degree; 0 is equal, 1 the worst.
        flip_map: FLIP [H,W] of every pixel, mask or not.
    """

    mse: float
    relative_mse: float
    ssim: float
    ssim_quarter: float
    flip: float
    flip_map: NDArray[np.float32]

    def as_json(self) -> dict[str, float]:
        """The figures without the map."""
        return {name: getattr(self, name) for name in ("mse", "relative_mse", "ssim", "ssim_quarter", "flip")}


def compare(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None, exposure: float = 0.0) -> Comparison:
    """Compare linear pictures [H,W,3], both multiplied by 2^exposure first.

    `mask`, [H,W] or [H,W,3], chooses the pixels that count: those above 0.5 in the mean of its channels. Windows of
    SSIM and FLIP about such a pixel reach beyond the mask.

    Raises QueryError for shapes that do not match, a mask without pixels, pixels or an exposure not finite;
    PrtbakeError where the extra `evaluate` is not installed.
    """
    if not abs(exposure) <= _MOST_STOPS:
        raise QueryError(f"compare: an exposure of {exposure:g} where one between ±{_MOST_STOPS:g} stops is expected")
    ours, theirs = (_picture(part, name) * 2.0**exposure for part, name in ((image, "image"), (reference, "reference")))
    if ours.shape != theirs.shape:
        raise QueryError(
            f"compare: the image is {_size(ours)}, the reference {_size(theirs)}; both must be of one size"
        )
    chosen = np.ones(ours.shape[:2], np.bool_) if mask is None else _chosen(mask, ours)
    squared = (ours - theirs) ** 2
    shown, wanted = displayed(ours), displayed(theirs)
    flip_map = _flip(shown, wanted)
    chosen_quarter = _quarter(chosen[..., None].astype(np.float64))[..., 0] > 0.5
    return Comparison(
        mse=float(squared[chosen].mean()),
        relative_mse=float((squared / (theirs**2 + _RELATIVE_FLOOR**2))[chosen].mean()),
        ssim=_ssim(shown, wanted, chosen),
        ssim_quarter=_ssim(_quarter(shown), _quarter(wanted), chosen_quarter),
        flip=float(flip_map[chosen].mean(dtype=np.float64)),
        flip_map=flip_map,
    )


def displayed(image: Array) -> Array:
    """Linear radiance as it is shown: the sRGB curve of IEC 61966-2-1, cut to [0,1]."""
    linear = np.clip(image, 0.0, 1.0)
    curve = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def _picture(image: ArrayLike, name: str) -> Array:
    pixels = np.asarray(image, np.float64)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise QueryError(f"compare: the {name} is of shape {list(pixels.shape)} where [H, W, 3] is expected")
    wrong = np.argwhere(~np.isfinite(pixels).all(axis=2))
    if len(wrong):
        row, column = wrong[0].tolist()
        raise QueryError(
            f"compare: {len(wrong)} of {pixels[..., 0].size} pixels of the {name} are not finite, the first at row "
            f"{row}, column {column}; render it again or mend it"
        )
    return pixels


def _chosen(mask: ArrayLike, image: Array) -> NDArray[np.bool_]:
    values = np.asarray(mask, np.float64)
    values = values.mean(axis=2) if values.ndim == 3 else values
    if values.shape != image.shape[:2]:
        raise QueryError(
            f"compare: the mask is of shape {list(values.shape)}, the pictures are {_size(image)}; both must "
            "be of one size"
        )
    chosen = values > 0.5
    if not chosen.any():
        raise QueryError("compare: the mask chooses no pixel; what counts is white, above 0.5")
    return np.asarray(chosen)


def _size(image: Array) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _quarter(image: Array) -> Array:
    """The mean of blocks of 4×4 pixels; what does not fill a block is left out."""
    h, w = image.shape[0] // 4, image.shape[1] // 4
    return np.asarray(image[: 4 * h, : 4 * w].reshape(h, 4, w, 4, image.shape[2]).mean(axis=(1, 3)))


def _ssim(image: Array, reference: Array, chosen: NDArray[np.bool_]) -> float:
    if min(image.shape[:2]) < _SSIM_WINDOW or not chosen.any():
        return float("nan")
    _mean, similarity = _evaluate_extra("skimage.metrics").structural_similarity(
        image,
        reference,
        channel_axis=2,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return float(similarity[chosen].mean())


def _flip(image: Array, reference: Array) -> NDArray[np.float32]:
    errors, _mean, _parameters = _evaluate_extra("flip_evaluator").evaluate(
        np.ascontiguousarray(reference, np.float32),
        np.ascontiguousarray(image, np.float32),
        "LDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": PIXELS_PER_DEGREE},
    )
    return np.asarray(errors, np.float32).reshape(reference.shape[:2])


def _evaluate_extra(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise PrtbakeError(
            f"compare: {package} is not installed; install the extra that brings it: pip install 'prt-bake[evaluate]'"
        ) from None
