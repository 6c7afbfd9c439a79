"""ONNX files, run by onnxruntime on the CPU (https://onnxruntime.ai/docs/api/python/api_summary.html).

Exporters differ in the names of inputs and outputs, in the type of numbers, and in whether the number of rows is fixed.
Some declare a wrong shape of the output, which is therefore taken from a run. skl2onnx writes the outputs of a
multilayer perceptron below one another, [3 · rows, 1].
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ModelError
from formats.extras import require

_TYPES: dict[str, Any] = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
}
_SILENT = 4
"""onnxruntime writes its log to stderr; what fails is raised, too."""
_ROWS = 5
"""A number of rows that is neither that of inputs nor of outputs, for the first run."""
_MOST_ROWS = 1 << 20
"""Largest fixed number of rows: each run computes all of them, however few are asked for."""
_LOCATION = re.compile(rb"\x0a\x08location\x12(.)", re.DOTALL)
"""The key of an entry of external data (`StringStringEntryProto` in onnx.proto) and the length of its value."""


def open_onnx(path: str | Path) -> "OnnxFunction":
    """The function [rows, 7] → [rows, 3] of an ONNX file.

    Raises:
        ModelError: the file is damaged, too new for the installed onnxruntime, or does not map 7 numbers to 3. The
            function raises it if it fails.
        PrtbakeError: onnxruntime is not installed.
    """
    require(str(path), "onnxruntime")
    onnxruntime: Any = import_module("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _SILENT
    # Each worker of a bake calls from its own thread, as of torch.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as fault:  # onnxruntime raises many types of errors, with no class in common
        text = str(fault)
        raise ModelError(f"{path}: {_fault_of_weights(Path(path), text) or _diagnosis(text, onnxruntime)}") from None
    return OnnxFunction(session, path)


class OnnxFunction:
    """The function of the only input and the only output [rows, 3].

    Attributes:
        input, output: name, shape and type in words.
        rows_per_call: a call of a multiple of it computes no row in vain.
    """

    def __init__(self, session: Any, path: str | Path) -> None:
        self._session = session
        self._path = path
        inputs = session.get_inputs()
        shapes = ", ".join(f"{each.name} {_shown(each.shape)}" for each in inputs)
        # Without a declared shape the list is empty.
        fits = len(inputs) == 1 and (not inputs[0].shape or (len(inputs[0].shape) == 2 and _is(inputs[0].shape[1], 7)))
        if not fits:
            raise ModelError(
                f"{path}: expected one input [rows, 7], found {shapes or 'none'}; wrap the network in one of this "
                "input, and export that"
            )
        if inputs[0].type not in _TYPES:
            raise ModelError(
                f"{path}: expected an input of float32, float64 or float16, found {inputs[0].name} of "
                f"{inputs[0].type[7:-1]}; export it in float32"
            )
        self._name = inputs[0].name
        self._dtype = _TYPES[inputs[0].type]
        rows = inputs[0].shape[0] if inputs[0].shape else None
        self._fixed = rows if isinstance(rows, int) else None
        if self._fixed is not None and not 1 <= self._fixed <= _MOST_ROWS:
            raise ModelError(
                f"{path}: expected 1 to {_MOST_ROWS} rows, found an input of {self._fixed} rows; export it with a "
                "dynamic number of rows"
            )
        self.rows_per_call = self._fixed or 1
        self._output, shape = self._only_output()
        self.input = f"{shapes or self._name} of {np.dtype(self._dtype).name}"
        self.output = f"{self._output} {shape}"

    def __call__(self, rows: NDArray[np.float64]) -> Any:
        """The outputs [rows, 3] of rows [rows, 7]; raises ModelError if the function fails."""
        if self._fixed is None:
            return self._run([self._output], rows)[0].reshape(-1, 3)
        results = []
        for first in range(0, len(rows), self._fixed):
            batch = rows[first : first + self._fixed]
            missing = self._fixed - len(batch)
            filled = np.concatenate([batch, np.repeat(batch[:1], missing, axis=0)]) if missing else batch
            results.append(self._run([self._output], filled)[0].reshape(-1, 3)[: len(batch)])
        return np.concatenate(results)

    def _run(self, outputs: list[str], rows: NDArray[np.float64]) -> list[Any]:
        try:
            found: list[Any] = self._session.run(outputs, {self._name: rows.astype(self._dtype)})
        except Exception as fault:  # as above
            kind = np.dtype(self._dtype).name
            raise ModelError(f"{self._path}: failed on [{len(rows)}, 7] of {kind} ({_reason(str(fault))})") from None
        return found

    def _only_output(self) -> tuple[str, str]:
        """The name of the output of three numbers a row, and its shape in words."""
        names: list[str] = [each.name for each in self._session.get_outputs()]
        rows = self._fixed or _ROWS
        found = [getattr(value, "shape", None) for value in self._run(names, np.full((rows, 7), 0.5))]
        fitting = [name for name, shape in zip(names, found, strict=True) if shape in ((rows, 3), (3 * rows, 1))]
        if len(fitting) == 1:
            return fitting[0], "[rows, 3]" if found[names.index(fitting[0])] == (rows, 3) else "[3 · rows, 1]"
        outputs = ", ".join(
            f"{name} {'that is no tensor' if shape is None else list(shape)}"
            for name, shape in zip(names, found, strict=True)
        )
        remedy = "; keep one by onnx.utils.extract_model" if fitting else ""
        raise ModelError(f"{self._path}: expected one output [{rows}, 3] from [{rows}, 7], found {outputs}{remedy}")


def _is(size: Any, number: int) -> bool:
    """Whether a declared size is a number, or may be: unknown sizes are None or a name."""
    return size == number or not isinstance(size, int)


def _shown(shape: list[Any]) -> str:
    return f"[{', '.join('rows' if size is None else str(size) for size in shape)}]"


def _fault_of_weights(path: Path, text: str) -> str | None:
    """What is wrong with the files of weights that a file names, if that is why onnxruntime refuses it."""
    content, folder = path.read_bytes(), path.parent.resolve()
    names = {content[at.end() : at.end() + at[1][0]].decode(errors="replace") for at in _LOCATION.finditer(content)}
    for name in sorted(filter(None, names)):
        beside = (folder / name).resolve()
        if Path(name).is_absolute() or not beside.is_relative_to(folder):
            return f"its weights are in {name}, outside its folder, from where none are read; put both into one folder"
        if not beside.is_file():
            return f"its weights are in {name}, which is not beside it; copy both files"
    if names and ("xternal" in text or "Deserialize tensor" in text):
        return f"its weights in {', '.join(sorted(names))} do not fit it, or are truncated; copy both files again"
    return None


def _diagnosis(text: str, onnxruntime: Any) -> str:
    """What a user can do about a file that onnxruntime refuses."""
    version = onnxruntime.__version__
    if "INVALID_PROTOBUF" in text or "No graph was found" in text or "not have a graph" in text:
        return "not an ONNX file, or truncated; export it again, or copy it again"
    if "IR version" in text or re.search(r"\bOpset \d+ is under development", text):
        found = re.search(r"(?:IR version: |Opset )(\d+)", text)
        kind = "IR version" if "IR version" in text else "opset"
        return (
            f"its {kind} {found[1] if found else ''} is newer than onnxruntime {version} supports; export it with an "
            "older opset_version, or update onnxruntime"
        )
    return f"onnxruntime {version} cannot run it ({_reason(text)})"


def _reason(text: str) -> str:
    """The first line of a message of onnxruntime, without its codes and places in its source."""
    text = re.sub(r"\[ONNXRuntimeError\] : \d+ : \w+ : ", "", text)
    text = re.sub(r"^Load model from .*? failed:", "", text)
    text = re.sub(r"\S*/\S+\.(?:cc|h):\d+ .*?\) (?=[A-Z])", "", text)
    text = re.sub(r"\w+\.(?:cc|h):\d+ \w+ ", "", text)
    return (text.strip().splitlines() or ["no reason given"])[0][:200]
