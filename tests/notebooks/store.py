"""Runs the notebooks and stores their outputs: `python -m tests.notebooks.store [NAME …]`.

A browser on a forge shows the stored outputs. Pictures are stored with 256 colours, widgets not at all.
"""

import base64
import io
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image

from tests import ROOT

WIDGET = "application/vnd.jupyter.widget-view+json"


def store(path: Path) -> None:
    """Run a notebook in an empty folder, and write it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    metadata = dict(notebook.metadata)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": folder}})
        client.execute()
    for cell in notebook.cells:
        cell.metadata.clear()
        if cell.cell_type == "code":
            cell.outputs = [smaller(output) for output in cell.outputs if WIDGET not in output.get("data", {})]
    notebook.metadata = nbformat.from_dict(metadata)
    notebook.metadata.language_info = {"name": "python"}
    nbformat.write(notebook, path)


def smaller(output: Any) -> Any:
    """Return the output with its picture in 256 colours."""
    if picture := output.get("data", {}).get("image/png"):
        stored = io.BytesIO()
        Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB").quantize(256).save(
            stored, "PNG", optimize=True
        )
        output["data"]["image/png"] = base64.b64encode(stored.getvalue()).decode()
    return output


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb")):
        store(ROOT / "notebooks" / f"{name}.ipynb")
