"""What an exported asset states of itself: `extras.prtbake` of a GLB (docs/reference/gltf.md)."""

import json
from pathlib import Path
from typing import Any

from formats.errors import FormatError


def is_exported(path: Path) -> bool:
    """Whether `prtbake export` wrote a file: X.glb, or the description X.json of a texture."""
    if not path.is_file():
        return False
    if path.suffix.lower() != ".json":
        return glb_extras(path) is not None
    try:
        return {"texture", "view_degree"} <= set(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        return False


def glb_extras(path: Path) -> dict[str, Any] | None:
    """Return `extras.prtbake` of the first mesh that has it; None if there is none, or the file is no GLB.

    Raises FormatError if the file is truncated.
    """
    with open(path, "rb") as file:
        head = file.read(20)
        if head[:4] != b"glTF" or head[16:] != b"JSON":
            return None
        size, expected = path.stat().st_size, int.from_bytes(head[8:12], "little")
        if size < expected:
            raise FormatError(f"{path}: is truncated: has {size} bytes of {expected}; copy or export it again")
        text = file.read(int.from_bytes(head[12:16], "little"))
    try:
        found = (mesh.get("extras", {}).get("prtbake") for mesh in json.loads(text)["meshes"])
        return next((extras for extras in found if isinstance(extras, dict)), None)
    except (ValueError, LookupError, AttributeError, TypeError):
        return None
