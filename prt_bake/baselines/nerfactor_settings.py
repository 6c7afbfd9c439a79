"""The size of a NeRFactor, and what its BRDF can be."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any

from formats.errors import ModelError, QueryError


@dataclass(frozen=True)
class NeRFactorSettings:
    """The size of a NeRFactor; the defaults are the published ones. Raises QueryError if a value is out of range.

    >>> from prt_bake.baselines import NeRFactorSettings
    >>> NeRFactorSettings(octaves=4).inputs
    27
    """

    layers: int = 4
    width: int = 128
    octaves: int = 10
    """Octaves of the encoding of positions."""
    bounded: bool = True
    """Whether the albedo is limited to 0.03–0.8, as published; otherwise it is any positive number."""
    reflectance: float = 0.04
    """Reflectance of the glossy lobe at normal incidence; 0 for no lobe."""
    least_roughness: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        valid = {
            "layers": (2 <= self.layers <= 64, "2 to 64"),
            "width": (1 <= self.width <= 4096, "1 to 4096"),
            "octaves": (0 <= self.octaves <= 20, "0 to 20"),
            "reflectance": (0.0 <= self.reflectance <= 1.0, "0 to 1"),
            "least_roughness": (0.01 <= self.least_roughness < 1.0, "0.01 to below 1"),
        }
        for name, (fits, expected) in valid.items():
            if not fits:
                raise QueryError(f"NeRFactor settings: {name}: expected {expected}, found {getattr(self, name)!r}")

    @property
    def inputs(self) -> int:
        """Numbers that encode a position."""
        return 3 + 6 * self.octaves

    def layer_shapes(self, outputs: int) -> list[tuple[int, int]]:
        """Inputs and outputs of each layer of an MLP; the last hidden one gets the encoded position again."""
        shapes = list(pairwise([self.inputs, *[self.width] * self.layers, outputs]))
        shapes[self.layers - 1] = (shapes[self.layers - 1][0] + self.inputs, self.width)
        return shapes

    def as_json(self) -> dict[str, Any]:
        """The settings by name."""
        return asdict(self)

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> "NeRFactorSettings":
        """The inverse of `as_json`; raises ModelError for values of a wrong kind."""
        known = {field.name: type(field.default) for field in fields(NeRFactorSettings)}
        for name, value in values.items():
            if name not in known or type(value) is not known[name]:
                expected = f"expected {known[name].__name__}" if name in known else f"known are {', '.join(known)}"
                raise ModelError(f"NeRFactor settings: {name}: {expected}, found {value!r}")
        try:
            return NeRFactorSettings(**values)
        except QueryError as fault:
            raise ModelError(str(fault)) from None
