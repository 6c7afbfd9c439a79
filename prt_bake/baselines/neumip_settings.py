"""The size of a NeuMIP: its textures and its decoder."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any

from formats.errors import ModelError, QueryError


@dataclass(frozen=True)
class NeuMIPSettings:
    """The size of a NeuMIP; the defaults are the published ones. Raises QueryError if a value is out of range.

    >>> from prt_bake.baselines import NeuMIPSettings
    >>> NeuMIPSettings(texels=256).channels
    7
    """

    texels: int = 512
    """Width and height of the finest texture."""
    channels: int = 7
    levels: int = 1
    """Textures, each of half the width of the one before, whose features are added. The published pyramid chooses a
    level by the size of a pixel, which Ŝ does not depend on."""
    width: int = 25
    layers: int = 3
    spread: float = 0.1
    """Standard deviation of the initial features."""
    seed: int = 0

    def __post_init__(self) -> None:
        valid = {
            "texels": (2 <= self.texels <= 1 << 14, "2 to 16384"),
            "channels": (1 <= self.channels <= 256, "1 to 256"),
            "levels": (
                self.levels >= 1 and self.texels >> (self.levels - 1) >= 2,
                "1 or more, each of 2 texels or more",
            ),
            "width": (1 <= self.width <= 4096, "1 to 4096"),
            "layers": (1 <= self.layers <= 64, "1 to 64"),
            "spread": (self.spread >= 0.0, "0 or more"),
        }
        for name, (fits, expected) in valid.items():
            if not fits:
                raise QueryError(f"NeuMIP settings: {name}: expected {expected}, found {getattr(self, name)!r}")

    @property
    def sizes(self) -> list[int]:
        """The width of the texture of each level."""
        return [self.texels >> level for level in range(self.levels)]

    @property
    def layer_shapes(self) -> list[tuple[int, int]]:
        """Inputs and outputs of each layer of the decoder."""
        widths = [self.channels + 6, *[self.width] * self.layers, 3]
        return list(pairwise(widths))

    def as_json(self) -> dict[str, Any]:
        """The settings by name."""
        return asdict(self)

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> "NeuMIPSettings":
        """The inverse of `as_json`; raises ModelError for values of a wrong kind."""
        known = {field.name: type(field.default) for field in fields(NeuMIPSettings)}
        for name, value in values.items():
            if name not in known or type(value) is not known[name]:
                expected = f"expected {known[name].__name__}" if name in known else f"known are {', '.join(known)}"
                raise ModelError(f"NeuMIP settings: {name}: {expected}, found {value!r}")
        try:
            return NeuMIPSettings(**values)
        except QueryError as fault:
            raise ModelError(str(fault)) from None
