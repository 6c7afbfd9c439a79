"""The meaning of the 7 inputs of a network of another program, in one line: `ORDER; key=value; …`, for example

    incident, position, outgoing; angles=unit; position=unit; axis=z

ORDER is the order of the three parts. `angles`: unit (θ/π, φ/2π) or radians (θ, φ), φ in [0, 2π). `position`: unit
((x − box_min) / longest side of the box) or object (object space). `axis`: z or y, the axis from which θ is measured; φ
runs from +x toward +y about z, and from +x toward −z about y.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError

DEFAULT_CONVENTION = "incident, position, outgoing; angles=unit; position=unit; axis=z"
_CHOICES = {"angles": ("unit", "radians"), "position": ("unit", "object"), "axis": ("z", "y")}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Convention:
    """The meaning of the seven inputs."""

    order: tuple[str, ...] = ("incident", "position", "outgoing")
    angles: str = "unit"
    position: str = "unit"
    axis: str = "z"

    @staticmethod
    def parse(text: str) -> "Convention":
        """Parse the one-line description; missing keys are as in the module's example. Raises QueryError."""
        first, *rest = (part.strip() for part in text.split(";"))
        order = tuple(part.strip() for part in first.split(","))
        if sorted(order) != ["incident", "outgoing", "position"]:
            raise QueryError(
                f"convention {text!r}: expected incident, position and outgoing in some order, found {first!r}"
            )
        chosen: dict[str, str] = {}
        for part in filter(None, rest):
            key, _, value = (word.strip() for word in part.partition("="))
            if key not in _CHOICES:
                raise QueryError(f"convention {text!r}: unknown key {key!r}; known are {', '.join(_CHOICES)}")
            if value not in _CHOICES[key]:
                raise QueryError(f"convention {text!r}: {key} must be {' or '.join(_CHOICES[key])}, found {value!r}")
            chosen[key] = value
        return Convention(order, **chosen)

    def rows(self, incident: Array, positions: Array, outgoing: Array, box_min: Array, box_side: float) -> Array:
        """The inputs [N·D,7] for incident [N,D,3], positions [N,3] and outgoing [N,3]; directions vary fastest."""
        directions = incident.shape[1]
        scaled = (positions - box_min) / box_side if self.position == "unit" else positions
        parts = {
            "incident": self._angles_of(incident.reshape(-1, 3)),
            "position": np.repeat(scaled, directions, axis=0),
            "outgoing": np.repeat(self._angles_of(outgoing), directions, axis=0),
        }
        return np.concatenate([parts[name] for name in self.order], axis=1)

    def _angles_of(self, directions: Array) -> Array:
        x, y, z = directions.T if self.axis == "z" else directions.T[[0, 2, 1]] * [[1], [-1], [1]]
        theta = np.arctan2(np.hypot(x, y), z)
        phi = np.arctan2(y, x) % (2.0 * np.pi)
        angles = np.stack([theta, phi], axis=-1)
        return angles / (np.pi, 2.0 * np.pi) if self.angles == "unit" else angles
