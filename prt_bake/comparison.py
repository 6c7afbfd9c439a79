"""How far a picture is from its reference: MSE, relative MSE, SSIM and FLIP."""

from dataclasses import asdict, dataclass
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import PrtbakeError, QueryError

Array = NDArray[np.float64]

PIXELS_PER_DEGREE = 67.0
_RELATIVE_FLOOR = 1e-2
_SSIM_WINDOW = 7


@dataclass(frozen=True)
class Comparison:
    """Figures over the pixels of the mask (all without one).

    mse: mean squared difference of linear radiance, after exposure. relative_mse: the same over (reference² + 0.01²).
    ssim, ssim_quarter: structural similarity of the pictures as shown (sRGB, cut to [0,1]), full and quarter size; nan for pictures
        smaller than its window of 7 pixels.
    flip: mean FLIP (Andersson et al. 2020) of the pictures as shown, at 67 pixels a degree; flip_map [H,W] its picture.
    """

    mse: float
    relative_mse: float
    ssim: float
    ssim_quarter: float
    flip: float
    flip_map: NDArray[np.float32]

    def as_json(self) -> dict[str, float]:
        """The figures without the picture."""
        figures = asdict(self)
        del figures["flip_map"]
        return figures


def compare(
    image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None, exposure: float = 0.0
) -> Comparison:
    """Compare linear pictures [H,W,3], both times 2^exposure; `mask` [H,W] picks the pixels that count (above 0.5).

    Raises QueryError for shapes that do not match, an empty mask or pixels that are not finite, PrtbakeError where the extra `evaluate`
    is not installed.
    """
    scale = 2.0**exposure
    ours, theirs = (_picture(part, name) * scale for part, name in ((image, "image"), (reference, "reference")))
    if ours.shape != theirs.shape:
        raise QueryError(f"compare: the image is {_size(ours)}, the reference {_size(theirs)}; they must be of one size")
    chosen = np.ones(ours.shape[:2], np.bool_) if mask is None else _mask(mask, ours.shape[:2])
    squared = (ours - theirs) ** 2
    shown, wanted = displayed(ours), displayed(theirs)
    flip_map = _flip(shown, wanted)
    return Comparison(
        mse=float(squared[chosen].mean()),
        relative_mse=float((squared / (theirs**2 + _RELATIVE_FLOOR**2))[chosen].mean()),
        ssim=_ssim(shown, wanted, chosen),
        ssim_quarter=_ssim(_quarter(shown), _quarter(wanted), _quarter(chosen.astype(np.float64)[..., None])[..., 0] > 0.5),
        flip=float(flip_map[chosen].mean()),
        flip_map=flip_map,
    )


def displayed(image: Array) -> Array:
    """Linear radiance as it is shown: the sRGB curve, cut to [0,1] (IEC 61966-2-1)."""
    linear = np.clip(image, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _picture(image: ArrayLike, name: str) -> Array:
    pixels = np.asarray(image, np.float64)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise QueryError(f"compare: {name} of shape {pixels.shape} where [H,W,3] is expected")
    wrong = np.argwhere(~np.isfinite(pixels).all(axis=2))
    if len(wrong):
        raise QueryError(
            f"compare: {len(wrong)} pixels of the {name} are not finite; the first is at row {wrong[0][0]}, column {wrong[0][1]}"
        )
    return pixels


def _mask(mask: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    values = np.asarray(mask, np.float64)
    values = values.mean(axis=2) if values.ndim == 3 else values
    if values.shape != shape:
        raise QueryError(f"compare: a mask of shape {values.shape} beside pictures of {shape}")
    chosen = values > 0.5
    if not chosen.any():
        raise QueryError("compare: the mask chooses no pixel; white is what counts")
    return np.asarray(chosen)


def _size(image: Array) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _quarter(image: Array) -> Array:
    """The mean of blocks of 4×4 pixels; what does not fill a block is left out."""
    h, w = image.shape[0] // 4 * 4, image.shape[1] // 4 * 4
    return np.asarray(image[:h, :w].reshape(h // 4, 4, w // 4, 4, -1).mean(axis=(1, 3)))


def _ssim(image: Array, reference: Array, chosen: NDArray[np.bool_]) -> float:
    if min(image.shape[:2]) < _SSIM_WINDOW or not chosen.any():
        return float("nan")
    _mean, similarity = _evaluate_extra("skimage.metrics").structural_similarity(
        image, reference, channel_axis=2, data_range=1.0, full=True
    )
    return float(similarity[chosen].mean())


def _flip(image: Array, reference: Array) -> NDArray[np.float32]:
    flip = _evaluate_extra("flip_evaluator")
    errors, _mean, _parameters = flip.evaluate(
        np.ascontiguousarray(reference, np.float32),
        np.ascontiguousarray(image, np.float32),
        "LDR",
        applyMagma=False,
        parameters={"ppd": PIXELS_PER_DEGREE},
    )
    return np.asarray(errors, np.float32).reshape(reference.shape[:2])


def _evaluate_extra(name: str) -> ModuleType:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise PrtbakeError(f"compare: {name} is not installed; install prt-bake[evaluate]") from None
