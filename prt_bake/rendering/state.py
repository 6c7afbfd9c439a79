"""The state of progressive rendering: sums over passes, their statistics, and the checkpoint.

Passes are independent and of equal distribution, so their variance gives the error of the mean, including the position
of rays within a pixel.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import FormatError
from formats.json_report import as_line
from formats.json_values import is_number
from formats.npz import read_arrays

Array = NDArray[np.float64]


_ARRAYS = ("radiance", "squares", "coverage")
_COVERAGE_ROUNDING = 1e-3


@dataclass
class Sums:
    """Sums over passes of radiance [H,W,3], of its squared deviations from the mean, and of coverage [H,W]; and the
    cost.

    history: rows (seconds, walks, relative noise), after passes 2, 4, 8, … and after the last.
    """

    radiance: Array
    squares: Array
    coverage: Array
    passes: int = 0
    walks: int = 0
    seconds: float = 0.0
    history: list[tuple[float, float, float]] = field(default_factory=list)

    @classmethod
    def empty(cls, height: int, width: int) -> "Sums":
        """Sums of no passes."""
        return cls(np.zeros((height, width, 3)), np.zeros((height, width, 3)), np.zeros((height, width)))

    def add(self, rows: slice, radiance: Array, coverage: Array) -> None:
        """Add some rows of pass number `passes`, each row once (Welford 1962)."""
        if self.passes:
            deviation = radiance - self.radiance[rows] / self.passes
            self.squares[rows] += deviation**2 * (self.passes / (self.passes + 1))
        self.radiance[rows] += radiance
        self.coverage[rows] += coverage

    def mean(self) -> Array:
        """The picture [H,W,3]."""
        return self.radiance / self.passes

    def standard_error(self) -> Array:
        """The standard error of the picture [H,W,3]; infinite after a single pass."""
        if self.passes < 2:
            return np.full_like(self.radiance, np.inf)
        return np.sqrt(self.squares / (self.passes * (self.passes - 1)))

    def mean_coverage(self) -> Array:
        """The object's share of each pixel [H,W]."""
        return self.coverage / self.passes

    def relative_noise(self) -> float:
        """As the function of that name."""
        return relative_noise(self.mean(), self.standard_error(), self.mean_coverage())

    def is_black(self) -> bool:
        """As the function of that name."""
        return is_black(self.mean(), self.mean_coverage())

    def add_to_history(self) -> None:
        """Add a row to the history, unless it is there."""
        if not self.history or self.history[-1][1] != self.walks:
            self.history.append((self.seconds, float(self.walks), self.relative_noise()))


def relative_noise(
    image: NDArray[np.floating], standard_error: NDArray[np.floating], coverage: NDArray[np.floating]
) -> float:
    """Root mean square of the standard error [H,W,3] over the mean radiance [H,W,3], over `object_pixels`.

    0 if the object is not visible or black; infinite if its mean is not positive, as of networks in the dark.
    """
    inside = object_pixels(coverage)
    noise, radiance = (np.asarray(part[inside], np.float64) for part in (standard_error, image))
    if not radiance.size or not radiance.any():
        return 0.0
    mean = float(np.mean(radiance))
    return float(np.sqrt(np.mean(noise**2))) / mean if mean > 0.0 else math.inf


def is_black(image: NDArray[np.floating], coverage: NDArray[np.floating]) -> bool:
    """Whether the object is visible and completely black."""
    inside = object_pixels(coverage)
    return bool(inside.any()) and not image[inside].any()


def object_pixels(coverage: NDArray[np.floating]) -> NDArray[np.bool_]:
    """The pixels [H,W] that the object covers completely; if there are none, those that it covers in part."""
    complete = coverage >= 1.0
    return np.asarray(complete if complete.any() else coverage > 0.0)


def checkpoint_path(output: str | Path) -> Path:
    """The checkpoint of the picture `output`: IMAGE.render.npz in the same folder."""
    output = Path(output)
    return output.with_name(output.name + ".render.npz")


def write_checkpoint(path: Path, sums: Sums, identity: dict[str, Any], limits: dict[str, Any]) -> None:
    """Write the sums, their identity and the requested limits atomically. Raises StorageError if writing fails."""
    numbers = {"passes": sums.passes, "walks": sums.walks, "seconds": sums.seconds, "history": sums.history}
    head = np.array(as_line({"identity": identity, "numbers": numbers, "asked": limits}))
    with replacing(path) as part, open(part, "wb") as file:
        np.savez(file, head=head, **{name: getattr(sums, name) for name in _ARRAYS})


def stored_identity(path: Path) -> dict[str, Any]:
    """The identity of a checkpoint's picture; empty if the file cannot be read, which `read_checkpoint` reports."""
    return _read_head(path, "identity")


def stored_limits(path: Path) -> dict[str, Any]:
    """The limits (spp, error, minutes) of the checkpoint's last run; empty if the file cannot be read.

    Raises FormatError if one is not a number from 0 on.
    """
    limits = _read_head(path, "asked")
    for name, value in limits.items():
        if value is not None and not (is_number(value) and value >= 0.0):
            raise FormatError(
                f"{path}: is damaged: {name} of its last run is {value!r}; expected a number from 0 on; render without "
                "resume"
            )
    return limits


def _read_head(path: Path, part: str) -> dict[str, Any]:
    try:
        return dict(json.loads(str(read_arrays(path)["head"]))[part])
    except (ValueError, KeyError, TypeError):
        return {}


def read_checkpoint(path: Path, identity: dict[str, Any]) -> Sums:
    """The sums of an earlier run.

    Raises FormatError if there is no file, if it is damaged, or if it has another `identity`; the message lists the
    differences.
    """
    if not path.is_file():
        raise FormatError(f"{path}: not found; there is nothing to resume, render without resume")
    try:
        arrays = read_arrays(path)
        head = json.loads(str(arrays["head"]))
        radiance, squares, coverage = (np.asarray(arrays[name], np.float64) for name in _ARRAYS)
        found, numbers = dict(head["identity"]), head["numbers"]
        # The noise after a single pass is infinite, which JSON does not hold.
        history = [(float(a), float(b), np.inf if c is None else float(c)) for a, b, c in numbers["history"]]
        counts = int(numbers["passes"]), int(numbers["walks"]), float(numbers["seconds"])
        sums = Sums(radiance, squares, coverage, *counts, history)
    except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as fault:
        kind = type(fault).__name__
        raise FormatError(f"{path}: not a readable checkpoint of a picture ({kind}); render without resume") from None
    differing = [name for name in identity if found.get(name) != identity[name]]
    if differing:
        differences = "; ".join(_difference(name, found.get(name), identity[name]) for name in differing)
        raise FormatError(
            f"{path}: belongs to another picture: {differences}; repeat the original arguments, or render "
            "without resume"
        )
    for sentence in _sum_faults(sums, identity.get("size", sums.coverage.shape[1::-1])):
        raise FormatError(f"{path}: is damaged: {sentence}; render without resume")
    return sums


def _sum_faults(sums: Sums, size: Sequence[int]) -> Iterator[str]:
    """Yield a sentence for every value that passes over a picture of `size`, width and height, cannot sum up to."""
    if sums.passes < 1 or sums.walks < 0 or not 0.0 <= sums.seconds < np.inf:
        yield (
            f"expected at least 1 pass and counts that are not negative, found passes {sums.passes}, walks "
            f"{sums.walks}, seconds {sums.seconds}"
        )
    pixels = tuple(size[::-1])
    for name, shape in {"radiance": (*pixels, 3), "squares": (*pixels, 3), "coverage": pixels}.items():
        values = getattr(sums, name)
        if values.shape != shape:
            yield f"{name} has shape {list(values.shape)}; expected {list(shape)}"
        elif not np.isfinite(values).all() or (name != "radiance" and (values < 0.0).any()):
            yield f"{name} has values that are negative or not finite"
    if sums.passes < (most := sums.coverage.max(initial=0.0)) * (1.0 - _COVERAGE_ROUNDING):
        yield f"coverage is up to {most:g}; expected at most {sums.passes}, the number of passes"


def _difference(name: str, found: Any, expected: Any) -> str:
    if isinstance(found, str) and isinstance(expected, str) and len(expected) == 64:
        return f"the {name} differs"
    return f"{name} is {as_line(found)} in the checkpoint, {as_line(expected)} now"
