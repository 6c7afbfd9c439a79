"""The settings of an importance module, and its two presets.

Source: the paper's sections on importance sampling and on network architecture: separate Fourier features, three hidden
layers of 512, 128 and 32 ReLU, one σ for a generalised Gaussian about the normal.
"""

from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any, Literal

from formats.errors import ModelError
from prt_bake.mathematics.lobe import SHAPES

MIN_UNIFORM_SHARE = 0.1
"""f/density is at most f·4π/uniform_share: a smaller share would only increase this bound."""


@dataclass(frozen=True)
class ImportanceSettings:
    """The architecture of an importance module; raises ModelError on inconsistent values."""

    features: int = 256
    """Fourier frequencies; each gives a cosine and a sine."""
    feature_mean: float = 0.0
    """Mean of the frequencies, in cycles per unit of input."""
    feature_spread: float = 0.09
    """Standard deviation of the frequencies that act on the outgoing direction."""
    position_spread: float = 1.0
    """Standard deviation of the frequencies that act on the position."""
    widths: tuple[int, ...] = (512, 128, 32)
    directions: Literal["spherical", "cartesian"] = "cartesian"
    """The outgoing direction as (θ/π, φ/2π), or as a unit vector."""
    shape: float = 3.0
    """β of the lobes: 2 is the Gaussian."""
    uniform_share: float = 0.1
    """Share of the samples that are uniform over the sphere."""
    lobes: int = 1
    tilted: bool = True
    """Whether the module predicts the axis of a lobe; otherwise it is the normal."""
    seed: int = 0
    """Draws the frequencies and the initial weights."""

    def __post_init__(self) -> None:
        if not self.widths or min(self.features, self.lobes, *self.widths) < 1:
            raise ModelError(
                f"importance settings: features, widths and lobes must be at least 1, "
                f"found {self.features}, {self.widths}, {self.lobes}"
            )
        if self.directions not in ("spherical", "cartesian"):
            raise ModelError(
                f"importance settings: directions must be spherical or cartesian, found {self.directions!r}"
            )
        if not SHAPES[0] <= self.shape <= SHAPES[1]:
            raise ModelError(f"importance settings: shape must be {SHAPES[0]:g} to {SHAPES[1]:g}, found {self.shape}")
        if not MIN_UNIFORM_SHARE <= self.uniform_share <= 1.0:
            raise ModelError(
                f"importance settings: uniform_share must be {MIN_UNIFORM_SHARE} to 1, found {self.uniform_share}"
            )

    @property
    def inputs(self) -> int:
        """Inputs per query: a position and a direction."""
        return 5 if self.directions == "spherical" else 6

    @property
    def outputs(self) -> int:
        """Outputs of the last layer per query: for each lobe a width, a tilt (3) if tilted, and a weight if several."""
        return self.lobes * (1 + 3 * self.tilted + (self.lobes > 1))

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of every tensor of a module with these settings."""
        shapes: dict[str, tuple[int, ...]] = {"frequencies": (self.features, self.inputs)}
        sizes = (2 * self.features, *self.widths, self.outputs)
        for number, (inputs, outputs) in enumerate(pairwise(sizes)):
            layer = f"hidden.{number}" if number < len(self.widths) else "output"
            shapes[f"{layer}.weight"], shapes[f"{layer}.bias"] = (outputs, inputs), (outputs,)
        return shapes

    def as_json(self) -> dict[str, Any]:
        """Plain values, as stored in a checkpoint."""
        return asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> "ImportanceSettings":
        """The inverse of `as_json`; raises ModelError naming a key that is unknown or of the wrong type."""
        known = {field.name: field.default for field in fields(ImportanceSettings)}
        resolved: dict[str, Any] = {}
        for name, value in values.items():
            if name not in known:
                raise ModelError(f"importance settings: unknown key {name!r}; known are {', '.join(known)}")
            expected = type(known[name])
            if expected is tuple and isinstance(value, list) and all(type(width) is int for width in value):
                resolved[name] = tuple(value)
            elif expected is float and type(value) is int:
                resolved[name] = float(value)
            elif type(value) is expected:
                resolved[name] = value
            else:
                raise ModelError(
                    f"importance settings: {name} must be of type {expected.__name__}, found {str(value)[:80]!r}"
                )
        return ImportanceSettings(**resolved)


IMPORTANCE_PRESETS: dict[str, ImportanceSettings] = {
    "paper": ImportanceSettings(
        feature_mean=18.0,
        feature_spread=1.0,
        position_spread=1.0,
        directions="spherical",
        shape=2.0,
        tilted=False,
    ),
    "measured": ImportanceSettings(),
}
"""`paper`: as published. `measured`: lower variance after the same training (tests/bench/importance.py)."""
