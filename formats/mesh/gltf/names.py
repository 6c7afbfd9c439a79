"""The files that a glTF file names, buffers and images, by URIs relative to its folder (glTF 2.0, section 2.8).

Without pydantic, so that commands can compare these names with those of their outputs before they read anything.
"""

import contextlib
import json
import os
import struct
from pathlib import Path
from urllib.parse import unquote

from formats.file_names import named_file


def named_files(path: str | os.PathLike[str]) -> list[Path]:
    """Return the files that a glTF file names and that exist.

    Raises:
        OSError: the file cannot be read.
        ValueError, TypeError, AttributeError: it is damaged.
    """
    with open(path, "rb") as file:
        content = file.read(20)
        is_binary = content[:4] == b"glTF" and len(content) == 20  # a header, then the size and type of the JSON
        size = min(struct.unpack_from("<I", content, 12)[0], os.path.getsize(path)) if is_binary else -1
        content = file.read(size) if is_binary else content + file.read()
    tables = json.loads(content.rstrip(b"\0"))
    uris = [entry["uri"] for kind in ("buffers", "images") for entry in tables.get(kind, []) if "uri" in entry]
    files = []
    for uri in uris:
        with contextlib.suppress(OSError, ValueError):  # a name that no file can have
            files.append(None if uri[:5].lower() == "data:" else find_file(path, uri))
    return [file for file in files if file is not None]


def find_file(path: str | os.PathLike[str], uri: str) -> Path | None:
    """Return the file that a URI in the glTF file `path` names; None if there is no such file.

    Raises:
        OSError, ValueError: the name is too long, or has a zero byte.
    """
    # Names are percent-encoded, but some writers do not encode them, or separate folders as Windows does.
    for name in (unquote(uri), uri, unquote(uri).replace("\\", "/")):
        file = named_file(path, name)
        if file.is_file():
            return file
    return None
