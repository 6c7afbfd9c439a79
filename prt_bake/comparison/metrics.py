"""How far a picture is from its reference: MSE, relative MSE, SSIM, FLIP and HDR-FLIP.

MSE is over linear radiance. SSIM and FLIP are over the pictures as they are shown: the sRGB curve, cut to [0,1].
HDR-FLIP is over linear radiance at a range of exposures (`prt_bake.comparison.flip`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.errors import QueryError, refuse_path
from formats.image.png import to_srgb
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
_MOST_STOPS = 100.0


@dataclass(frozen=True)
class Comparison:
    """Figures over the pixels of the mask (all without one).

    Attributes:
        mse: mean squared difference of linear radiance, after exposure.
        relative_mse: the mean of squared difference / (reference² + 0.01²), as pbrt's MRSE damps dark pixels.
        relative_rmse: sqrt(Σ squared difference / Σ reference²); nan where the reference is black.
        ssim: structural similarity (Wang et al. 2004: Gaussian window, sigma 1.5), the mean over channels; 1 is equal,
            nan for pictures smaller than its window of 11 pixels.
        ssim_quarter: the same of the pictures' means over 4×4 pixels; SSIM prefers blur to noise, this one less so.
        flip: mean FLIP (Andersson et al. 2020) at 67 pixels a degree; 0 is equal, 1 the worst.
        flip_map: FLIP [H,W] of every pixel, mask or not.
        hdr_flip: mean HDR-FLIP over `hdr_exposures`, and its map; None where it was not asked for.
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
        """The figures without the maps."""
        names = ("mse", "relative_mse", "relative_rmse", "ssim", "ssim_quarter", "flip")
        figures: dict[str, Any] = {name: getattr(self, name) for name in names}
        if self.hdr_exposures is not None:
            figures |= {"hdr_flip": self.hdr_flip, "hdr_exposures": self.hdr_exposures._asdict()}
        return figures


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

    `mask`, [H,W] or [H,W,3], chooses the pixels that count: those above 0.5 in the mean of its channels. Windows of
    SSIM and FLIP about such a pixel reach beyond the mask. `hdr` asks for HDR-FLIP too: over the exposures that its
    paper takes for the reference, or over those from a first to a last, in stops on top of `exposure`. `names` are
    what messages call the pictures and the mask.

    Raises QueryError for shapes that do not match, a mask without pixels, pixels or exposures out of their domain;
    PrtbakeError where the extra `evaluate` is not installed.
    """
    ours, theirs, chosen = checked(image, reference, mask, exposure, names)
    squared = (ours - theirs) ** 2
    signal = float((theirs[chosen] ** 2).sum())
    shown, wanted = to_srgb(ours), to_srgb(theirs)
    map_of_flip = flip_map(shown, wanted)
    exposures = None if hdr is False else paper_exposures(theirs) if hdr is True else exposures_between(*hdr)
    map_of_hdr = None if exposures is None else hdr_flip_map(ours, theirs, exposures)
    return Comparison(
        mse=float(squared[chosen].mean()),
        relative_mse=float((squared / (theirs**2 + RELATIVE_FLOOR**2))[chosen].mean()),
        relative_rmse=float(np.sqrt(squared[chosen].sum() / signal)) if signal > 0.0 else float("nan"),
        ssim=_mean(ssim_map(shown, wanted), chosen),
        ssim_quarter=_mean(ssim_map(quartered(shown), quartered(wanted)), quarter_mask(chosen)),
        flip=_mean(map_of_flip, chosen),
        flip_map=map_of_flip,
        hdr_flip=None if map_of_hdr is None else _mean(map_of_hdr, chosen),
        hdr_exposures=exposures,
        hdr_flip_map=map_of_hdr,
    )


def checked(
    image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None, exposure: float, names: Names = NAMES
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Both pictures [H,W,3] times 2^exposure and the pixels [H,W] that count; raises QueryError as `compare`."""
    if not abs(exposure) <= _MOST_STOPS:
        raise QueryError(f"compare: an exposure of {exposure:g} where one between ±{_MOST_STOPS:g} stops is expected")
    ours, theirs = (
        _picture(part, name) * 2.0**exposure for part, name in zip((image, reference), names[:2], strict=True)
    )
    if ours.shape != theirs.shape:
        raise QueryError(f"compare: {names[0]} is {_size(ours)}, {names[1]} {_size(theirs)}; both must be of one size")
    return ours, theirs, np.ones(ours.shape[:2], np.bool_) if mask is None else _chosen(mask, ours, names[2])


def ssim_map(image: Array, reference: Array) -> Array:
    """SSIM [H,W] of pictures as they are shown [H,W,3], the mean over channels; nan for those below its window."""
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
    """The mean of blocks of 4×4 pixels [H/4,W/4,3]; what does not fill a block is left out."""
    h, w = image.shape[0] // 4, image.shape[1] // 4
    return np.asarray(image[: 4 * h, : 4 * w].reshape(h, 4, w, 4, image.shape[2]).mean(axis=(1, 3)))


def quarter_mask(chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The blocks of 4×4 pixels of which more than half are chosen."""
    return np.asarray(quartered(chosen[..., None].astype(np.float64))[..., 0] > 0.5)


def _picture(image: ArrayLike, name: str) -> Array:
    refuse_path(name, image, "prt.read_image")
    pixels = np.asarray(image, np.float64)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise QueryError(f"compare: {name} is of shape {list(pixels.shape)} where [H, W, 3] is expected")
    wrong = np.argwhere(~np.isfinite(pixels).all(axis=2))
    if len(wrong):
        row, column = wrong[0].tolist()
        raise QueryError(
            f"compare: {len(wrong)} of {pixels[..., 0].size} pixels of {name} are not finite, the first at row "
            f"{row}, column {column}; render it again or mend it"
        )
    return pixels


def _chosen(mask: ArrayLike, image: Array, name: str) -> NDArray[np.bool_]:
    values = np.asarray(mask, np.float64)
    values = values.mean(axis=2) if values.ndim == 3 else values
    if values.shape != image.shape[:2]:
        raise QueryError(
            f"compare: {name} is of shape {list(values.shape)}, the pictures are {_size(image)}; both must "
            "be of one size"
        )
    chosen = values > 0.5
    if not chosen.any():
        raise QueryError(f"compare: {name} chooses no pixel; what counts is white, above 0.5")
    return np.asarray(chosen)


def _size(image: Array) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _mean(values: NDArray[np.floating], chosen: NDArray[np.bool_]) -> float:
    return float(values[chosen].mean(dtype=np.float64)) if chosen.any() else float("nan")
