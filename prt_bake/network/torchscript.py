"""Networks of other programs: a TorchScript file that maps 7 numbers to 3, with a description of its input.

The description is one line, `ORDER; key=value; …`, for example

    incident, position, outgoing; angles=unit; position=unit; axis=z

ORDER is the order of the three parts. `angles`: unit (θ/π, φ/2π) or radians (θ, φ), φ in [0, 2π). `position`: unit
((x − box_min) / longest side of the box) or object (object space). `axis`: z or y, the axis from which θ is measured; φ
runs from +x toward +y about z, and from +x toward −z about y.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from formats.errors import ModelError, QueryError

DEFAULT_CONVENTION = "incident, position, outgoing; angles=unit; position=unit; axis=z"
ROWS_PER_BATCH = 8192
_CHOICES = {"angles": ("unit", "radians"), "position": ("unit", "object"), "axis": ("z", "y")}


@dataclass(frozen=True)
class Convention:
    """The meaning of the seven inputs."""

    order: tuple[str, ...] = ("incident", "position", "outgoing")
    angles: str = "unit"
    position: str = "unit"
    axis: str = "z"

    @staticmethod
    def parse(text: str) -> "Convention":
        """Parses the one-line description; missing keys are as in the module's example. Raises QueryError."""
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


class TorchScriptTransport:
    """A TorchScript function [rows, 7] → [rows, 3] as Ŝ [1/sr]."""

    def __init__(self, function: Any, convention: Convention, box_min: ArrayLike, box_side: float, name: str) -> None:
        """box_min [3] and box_side are the object's bounding box; used if positions are `unit`."""
        self.convention = convention
        self.metadata = {"name": name, "convention": repr(convention)}
        self._function = function
        self._box_min = np.asarray(box_min, dtype=np.float64)
        self._box_side = float(box_side)

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3], float32: incident [D,3] or [N,D,3], positions [N,3], outgoing [N,3].

        Raises ModelError if the function fails or returns another shape.
        """
        x, eye, light = (np.asarray(vectors, dtype=np.float64) for vectors in (positions, outgoing, incident))
        light = np.broadcast_to(light, (len(x), *light.shape[-2:]))
        directions = light.shape[1]
        parts = {
            "incident": self._angles(light.reshape(-1, 3)),
            "position": np.repeat(self._scaled(x), directions, axis=0),
            "outgoing": np.repeat(self._angles(eye), directions, axis=0),
        }
        rows = np.concatenate([parts[name] for name in self.convention.order], axis=1).astype(np.float32)
        result = np.empty((len(rows), 3), dtype=np.float32)
        with torch.inference_mode():
            for first in range(0, len(rows), ROWS_PER_BATCH):
                result[first : first + ROWS_PER_BATCH] = self._call(
                    torch.from_numpy(rows[first : first + ROWS_PER_BATCH])
                )
        return result.reshape(len(x), directions, 3)

    def _call(self, rows: torch.Tensor) -> NDArray[np.float32]:
        try:
            radiance = self._function(rows)
        except RuntimeError as fault:
            last = str(fault).strip().splitlines()[-1]
            raise ModelError(f"{self.metadata['name']}: failed on [rows, 7] float32 ({last})") from None
        if not isinstance(radiance, torch.Tensor) or tuple(radiance.shape) != (len(rows), 3):
            found = tuple(radiance.shape) if isinstance(radiance, torch.Tensor) else type(radiance).__name__
            raise ModelError(f"{self.metadata['name']}: expected [rows, 3] from [rows, 7], found {found}")
        return np.asarray(radiance.detach().float().cpu().numpy())

    def _angles(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = directions.T if self.convention.axis == "z" else directions.T[[0, 2, 1]] * [[1], [-1], [1]]
        theta = np.arctan2(np.hypot(x, y), z)
        phi = np.arctan2(y, x) % (2.0 * np.pi)
        angles = np.stack([theta, phi], axis=-1)
        return angles / (np.pi, 2.0 * np.pi) if self.convention.angles == "unit" else angles

    def _scaled(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        return (positions - self._box_min) / self._box_side if self.convention.position == "unit" else positions


def load_torchscript(
    path: str | Path,
    convention: str = DEFAULT_CONVENTION,
    box_min: ArrayLike = (0.0, 0.0, 0.0),
    box_side: float = 1.0,
) -> TorchScriptTransport:
    """A transport from a TorchScript file and the description of its input (see the module).

    box_min [3] and box_side are those of the mesh to be baked. A TorchScript file is a program: load only files that
    you trust. Raises ModelError if the file is not TorchScript or does not map 7 numbers to 3, QueryError on a bad
    description.
    """
    described = Convention.parse(convention)
    if not Path(path).is_file():
        raise ModelError(f"{path}: no such file; expected a TorchScript file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch calls the format deprecated; people still use it
            load: Any = torch.jit.load
            function = load(str(path), map_location="cpu")
    except (RuntimeError, ValueError, OSError):
        raise ModelError(f"{path}: not a TorchScript file; expected what torch.jit.save writes") from None
    transport = TorchScriptTransport(function.eval(), described, box_min, box_side, str(path))
    transport.evaluate([[0.0, 0.0, 1.0]], np.asarray(box_min, dtype=np.float64)[None], [[0.0, 0.0, 1.0]])
    return transport
