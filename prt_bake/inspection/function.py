"""Description and faults of an ONNX file, a function of seven numbers that `prtbake bake --convention` takes."""

from pathlib import Path
from typing import Any

from prt_bake.network.functions import load_function
from prt_bake.network.functions.onnx import open_onnx


def describe(path: Path) -> dict[str, Any]:
    """Return its input and its output, as "name [rows, numbers] of float32"."""
    function = open_onnx(path)
    return {"input": function.input, "output": function.output}


def find_faults(path: Path) -> list[str]:
    """Raise the error of loading the function; else return no faults."""
    load_function(path)
    return []


def find_remarks(path: Path) -> list[str]:
    """Return what the function is."""
    function = open_onnx(path)
    return [f"an ONNX function, from {function.input} to {function.output}; `prtbake bake --convention` takes it"]
