"""Scores of predicted pictures against a test set, with and without the noise of its references.

Each picture is compared over the pixels that the object covers completely. Outside of them both pictures are that of
the reference, so that a predicted background does not matter. All pictures of a set have one exposure: the median over
the references of their objects' median luminance becomes 0.18, so that dark pictures count as dark.

The figures of a set are means over its pictures, and the intervals those of a bootstrap over pictures. Without noise
means: the variance of both pictures is subtracted from the squared error, and FLIP and SSIM are extrapolated
(`prt_bake.comparison.noise_free`). The uncertainty of the extrapolation is common to all pictures, and the interval
includes it. Predictions without an error layer count as exact.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import FormatError, QueryError, StorageError
from formats.image import read_layers
from formats.image.exr import Layers
from formats.image.gamut import LUMINANCE
from prt_bake.comparison.alpha import premultiplied
from prt_bake.comparison.metrics import checked, compare
from prt_bake.comparison.noise import PixelErrors, errors_of, same_random_numbers, unusable_reason
from prt_bake.comparison.noise_free import compare_without_noise
from prt_bake.comparison.object_figures import MIDDLE_GREY
from prt_bake.mathematics.noise_free import Interval, ratio
from prt_bake.olat.description import NAME, read_dataset
from prt_bake.olat.pictures import SKIES, TEST

METRICS = ("mse", "ssim", "flip")
_SUFFIXES = (".exr", ".png")
_UNKNOWN = Interval(math.nan, math.nan, math.nan)
_FEWEST = 8
"""Pictures; fewer give no interval."""
_LEAST_OF_NOISE = 0.5
"""Share of the squared noise below which the squared error of independent pictures hardly ever is."""


@dataclass(frozen=True)
class PictureScore:
    """The metrics of one picture, the same without noise, and those of noise alone."""

    measured: dict[str, float]
    noise_free: dict[str, Interval] = field(default_factory=dict)
    of_noise: dict[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        noise_free = {metric: found.as_json() for metric, found in self.noise_free.items()}
        return {"measured": self.measured, "noise_free": noise_free, "of_noise": self.of_noise}


@dataclass(frozen=True)
class SetScore:
    """Scores of the pictures of a set by their names, all at an exposure in stops."""

    exposure: float
    pictures: dict[str, PictureScore]

    def measured(self, metric: str) -> Interval:
        """The mean of a metric over pictures, with its interval."""
        return _mean([score.measured[metric] for score in self.pictures.values()])

    def noise_free(self, metric: str) -> Interval:
        """The same without noise; NaN if noise was kept."""
        found = [score.noise_free.get(metric, _UNKNOWN) for score in self.pictures.values()]
        mean = _mean([each.value for each in found])
        if metric == "mse" or not np.isfinite(mean.value) or len(found) < _FEWEST:
            return mean
        lows, highs = [each.low for each in found], [each.high for each in found]
        # An end of the interval without bounds of its own is that of pictures at the limit of the metric.
        low, high = _mean(lows).low, _mean(highs).high
        return Interval(
            mean.value,
            float(low if np.isfinite(low) else np.mean(lows)),
            float(high if np.isfinite(high) else np.mean(highs)),
        )

    def of_noise(self, metric: str) -> float:
        """The mean of a metric over pictures that differ by noise alone; NaN if noise was kept."""
        return _mean([score.of_noise.get(metric, np.nan) for score in self.pictures.values()]).value

    def shares_noise(self) -> bool:
        """Whether predictions are nearer to the references than independent noise allows, as copies of them are."""
        measured = self.measured("mse").value
        return measured == 0.0 or measured < _LEAST_OF_NOISE * self.of_noise("mse")

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values; PSNR is that of the mean squared error, with a peak of 1."""
        report: dict[str, Any] = {"pictures": len(self.pictures), "exposure": self.exposure}
        for part in (self.measured, self.noise_free):
            means = {metric: part(metric) for metric in METRICS}
            means["psnr"] = psnr(means["mse"])
            report[part.__name__] = {metric: mean.as_json() for metric, mean in means.items()}
        report["of_noise"] = {metric: self.of_noise(metric) for metric in METRICS}
        report["of_noise"]["psnr"] = _decibels(report["of_noise"]["mse"])
        report["shares_noise"] = self.shares_noise()
        report["by_picture"] = {name: score.as_json() for name, score in self.pictures.items()}
        return report


def score(
    predicted: Path,
    folder: Path,
    *,
    exposure: float | None = None,
    keep_noise: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> dict[str, SetScore]:
    """Scores by set: "test", "held_out_skies", or the one of them that `predicted` has a folder for.

    Args:
        predicted: folder with `test/NAME.exr` or `.png`, and `held_out_skies/NAME.exr` or `.png`.
        folder: of the test set.
        exposure: in stops; None chooses it from the references.
        keep_noise: measures only, without the figures without noise.
        progress: called with the finished share and a text.

    Raises FormatError for a folder that is no test set, StorageError for missing pictures, and QueryError for pictures
    of other sizes or that are not finite, naming the first.
    """
    if (predicted / NAME).is_file() and not (folder / NAME).is_file():
        raise QueryError(f"{predicted}: is a test set, and {folder} is none; give the predicted pictures first")
    read_dataset(folder)
    names = {name: _names(folder, name) for name in (TEST, SKIES) if (predicted / name).is_dir()}
    chosen = {name: found for name, found in names.items() if found}
    if not chosen:
        raise StorageError(
            f"{predicted}: expected predicted pictures in {TEST}/ or {SKIES}/, found no such folder; give them the "
            f"names that they have in {folder}"
        )
    files = {picture: _predicted(predicted, picture) for pictures in chosen.values() for picture in pictures}
    scores, done = {}, 0
    for name, pictures in chosen.items():
        stops = _exposure(folder, pictures) if exposure is None else exposure
        found = {}
        for picture in pictures:
            found[picture] = _score(files[picture], folder / f"{picture}.exr", stops, keep_noise)
            done += 1
            if progress is not None:
                progress(done / len(files), f"{done} of {len(files)} pictures")
        scores[name] = SetScore(stops, found)
    return scores


def psnr(mse: Interval) -> Interval:
    """Peak signal-to-noise ratio in decibels of a mean squared error, with a peak of 1; NaN below 0.

    >>> round(psnr(Interval(0.01, 0.001, 0.1)).high, 6)
    30.0
    """
    return Interval(*(_decibels(error) for error in (mse.value, mse.high, mse.low)))


def _mean(values: list[float]) -> Interval:
    return ratio(np.array(values), np.ones(len(values)), 0)


def _decibels(error: float) -> float:
    if error == 0.0:
        return math.inf
    return -10.0 * math.log10(error) if error > 0.0 else math.nan


def _names(folder: Path, name: str) -> list[str]:
    path = folder / f"transforms_{name}.json"
    if not path.exists():
        return []
    try:
        return [str(frame["file_path"]) for frame in json.loads(path.read_text(encoding="utf-8"))["frames"]]
    except (OSError, ValueError, KeyError, TypeError) as cause:
        raise FormatError(f"{path}: cannot be read: {cause}; make the test set again") from cause


def _predicted(predicted: Path, picture: str) -> Path:
    found = [path for suffix in _SUFFIXES if (path := predicted / f"{picture}{suffix}").exists()]
    if not found:
        raise StorageError(
            f"{predicted / picture}.exr: there is no such file, nor a .png; every picture of a set is scored, so "
            "predict it too, or leave out the whole set"
        )
    return found[0]


def _exposure(folder: Path, pictures: list[str]) -> float:
    """The exposure at which the median of the pictures' median luminance is 0.18."""
    medians = []
    for picture in pictures:
        path = folder / f"{picture}.exr"
        layers = read_layers(path)
        medians.append(float(np.median(layers.image[_mask(path, layers)] @ LUMINANCE)))
    median = float(np.median(medians))
    if not median > 0.0:
        raise QueryError(f"{folder}: no light reaches the object in half of the pictures; choose an --exposure")
    return math.log2(MIDDLE_GREY / median)


def _score(path: Path, reference_path: Path, stops: float, keep_noise: bool) -> PictureScore:
    image, reference = (premultiplied(each, read_layers(each)) for each in (path, reference_path))
    checked(image.image, reference.image, None, stops, (str(path), str(reference_path), ""))
    mask = _mask(reference_path, reference)
    filled = replace(image, image=np.where(mask[..., None], image.image, reference.image))
    found = compare(filled.image, reference.image, mask, stops)
    measured = {metric: float(getattr(found, metric)) for metric in METRICS}
    if keep_noise or np.array_equal(filled.image, reference.image):
        exact = {metric: Interval(value, value, value) for metric, value in measured.items()}
        return PictureScore(measured, {} if keep_noise else exact)
    errors = _errors(path, image, reference, mask)
    noise_free = compare_without_noise(filled.image, reference.image, errors, mask, stops)
    return PictureScore(
        measured,
        {metric: noise_free.figures[metric] for metric in METRICS},
        {metric: noise_free.of_noise[metric] for metric in METRICS},
    )


def _mask(path: Path, reference: Layers) -> NDArray[np.bool_]:
    """The pixels [H,W] that the object covers completely."""
    coverage, error = (reference.layers.get(name) for name in ("A", "error"))
    if coverage is None or error is None:
        raise FormatError(f"{path}: expected the layers A and error of a test set, found none; make the set again")
    if not (coverage >= 1.0).any():
        raise FormatError(f"{path}: the object covers no pixel completely; make the test set with a larger --size")
    return np.asarray(coverage >= 1.0)


def _errors(path: Path, image: Layers, reference: Layers, mask: NDArray[np.bool_]) -> PixelErrors:
    """Standard errors of both pictures, 0 outside the object."""
    if same_random_numbers(image, reference):
        raise QueryError(
            f"{path}: was rendered with the random numbers of the reference, so that their noise is correlated; render "
            "it with another seed, or add --keep-noise"
        )
    if reason := unusable_reason(path, image):
        raise QueryError(f"{reason}; write it without that layer, or add --keep-noise")
    errors = errors_of(image, reference)
    assert errors is not None  # references have an error layer
    inside = mask[..., None]
    return PixelErrors(*(np.where(inside, part, 0.0) for part in (errors.image, errors.reference, errors.shared)))
