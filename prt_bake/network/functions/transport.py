"""A TorchScript or ONNX file that maps 7 numbers to 3, as a transport.

The files are run by torch and by onnxruntime (the extra `onnx`), whose formats they are.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import numbers
from formats.errors import ModelError, QueryError
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.network.functions.convention import DEFAULT_CONVENTION, Convention

ROWS_PER_BATCH = 8192
_PROBES = 64
"""Rows by which a file is tested when it is loaded."""
_PAIRS = (1, 23, 45)
"""First rows of the pairs that are evaluated apart; odd, so that files with a fixed number of rows batch them again."""
_SAME = 0.01
"""Largest difference, over the largest value, that rounding may make: float16 makes thousandths."""
Function = Callable[[NDArray[np.float64]], Any]
"""[rows, 7] → [rows, 3]."""


class FunctionTransport:
    """A function [rows, 7] → [rows, 3] of a file as Ŝ [1/sr]."""

    def __init__(
        self, function: Function, convention: str, box_min: ArrayLike, box_side: float, path: str | Path
    ) -> None:
        """box_min [3] and box_side are the object's bounding box; used if positions are `unit`."""
        self.convention = Convention.parse(convention)
        self.metadata = {"name": str(path), "convention": repr(self.convention)}
        self.label = str(path)
        self._function = function
        multiple = getattr(function, "rows_per_call", 1)
        self._rows_per_batch = max(multiple, ROWS_PER_BATCH // multiple * multiple)
        self._box_min = np.asarray(box_min, dtype=np.float64)
        self._box_side = float(box_side)
        self._source = (Path(path).absolute(), convention, self._box_min, self._box_side)

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3], float32: incident [D,3] or [N,D,3], positions [N,3], outgoing [N,3].

        Raises ModelError if the function fails or returns another shape.
        """
        x, eye, light = (np.asarray(vectors, dtype=np.float64) for vectors in (positions, outgoing, incident))
        light = np.broadcast_to(light, (len(x), *light.shape[-2:]))
        rows = self.convention.rows(light, x, eye, self._box_min, self._box_side)
        result = np.empty((len(rows), 3), dtype=np.float32)
        for first in range(0, len(rows), self._rows_per_batch):
            batch = rows[first : first + self._rows_per_batch]
            result[first : first + len(batch)] = self._call(batch)
        return result.reshape(*light.shape)

    def _call(self, rows: NDArray[np.float64]) -> NDArray[Any]:
        found = self._function(rows)
        try:
            radiance = numbers("its output", found)
        except QueryError as fault:
            raise ModelError(f"{self.label}: {fault}") from None
        if radiance.shape != (len(rows), 3):
            raise ModelError(
                f"{self.label}: expected [rows, 3] from [rows, 7], found {list(radiance.shape)} from {list(rows.shape)}"
            )
        return radiance

    def refuse_other_rows(self) -> None:
        """Raise ModelError if values change from call to call, or with the other rows of a batch.

        Dropout does the one, batch normalisation the other, in a network that was exported while it was trained.
        """
        light, eye = fibonacci(_PROBES), fibonacci(_PROBES)[::-1]
        positions = self._box_min + self._box_side * (0.5 + 0.5 * np.roll(light, 1, axis=0))
        rows = self.convention.rows(light[:, None], positions, eye, self._box_min, self._box_side)
        values = self._call(rows)
        size = np.abs(values[np.isfinite(values)]).max(initial=0.0)
        self._compare(self._call(rows), values, size, "from call to call, as with dropout in training")
        for first in _PAIRS:
            pair = slice(first, first + 2)
            cause = "with the other rows of a batch, as with batch normalisation in training or with rows as columns"
            self._compare(self._call(rows[pair]), values[pair], size, cause)

    def _compare(self, found: NDArray[Any], expected: NDArray[Any], size: float, cause: str) -> None:
        if not np.allclose(found, expected, rtol=0.0, atol=_SAME * size, equal_nan=True):
            raise ModelError(
                f"{self.label}: expected values that depend on their own row of 7 numbers alone, found that they "
                f"change {cause}; export the network in evaluation mode, in torch after network.eval()"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Other processes open the file again: what runs it cannot be sent."""
        return load_function, self._source


def load_function(
    path: str | Path,
    convention: str = DEFAULT_CONVENTION,
    box_min: ArrayLike = (0.0, 0.0, 0.0),
    box_side: float = 1.0,
) -> FunctionTransport:
    """A transport from a TorchScript file or an ONNX file (`.onnx`) and the description of its input.

    Args:
        path: the file. A TorchScript file is a program: load only files that you trust.
        convention: the meaning of the 7 inputs (`prt_bake.network.functions.convention`).
        box_min, box_side: least corner [3] and longest side of the bounding box of the mesh to be baked.

    Raises:
        ModelError: the file is missing, damaged, in training mode, or does not map 7 numbers to 3.
        QueryError: a bad description.
        PrtbakeError: onnxruntime is not installed.

    Example:
        >>> from prt_bake.network.functions import load_function
        >>> function = load_function("function.onnx", "incident, position, outgoing; angles=unit")
        >>> function.evaluate([[0, 0, 1]], [[0.1, 0.2, 0.3]], [[0, 0, 1]]).shape
        (1, 1, 3)
    """
    Convention.parse(convention)
    if not Path(path).is_file():
        raise ModelError(f"{path}: no such file; expected a TorchScript or an ONNX file")
    open_function: Callable[[str | Path], Function]
    if Path(path).suffix.lower() == ".onnx":
        from prt_bake.network.functions.onnx import open_onnx

        open_function = open_onnx
    else:
        from prt_bake.network.functions.torchscript import open_torchscript

        open_function = open_torchscript
    transport = FunctionTransport(open_function(path), convention, box_min, box_side, path)
    transport.refuse_other_rows()
    return transport
