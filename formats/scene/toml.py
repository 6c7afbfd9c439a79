"""Text of scene and lights files, TOML 1.0 (https://toml.io/en/v1.0.0)."""

import tomllib
from pathlib import Path
from typing import Any

from formats.atomic import existing
from formats.errors import FormatError
from formats.text import without_byte_order_mark


def read_toml(path: Path, error: type[FormatError], kind: str) -> dict[str, Any]:
    """Read the tables of a TOML file.

    Args:
        path: the file.
        error: the class of errors to raise.
        kind: what the file should be, such as "a scene file", for messages.

    Raises:
        FormatError: `error`, if the file is no TOML, or not in UTF-8.
        StorageError: the file is missing.
    """
    content = without_byte_order_mark(existing(path).read_bytes(), path, error)
    if b"\0" in content:
        raise error(f"{path}: is not {kind}: expected UTF-8 text, found binary data, or UTF-16; save it as UTF-8")
    try:
        return tomllib.loads(content.decode("utf-8"))
    except UnicodeDecodeError as cause:
        line = content.count(b"\n", 0, cause.start) + 1
        found = f"found the byte {content[cause.start]:#x} in line {line}, as in Latin-1"
        advice = "save it again with the encoding UTF-8"
        raise error(f"{path}: is not {kind}: expected UTF-8 text, {found}; {advice}") from cause
    except (ValueError, RecursionError) as cause:  # tomllib also raises them for long numbers and deep nesting
        advice = "correct the line" if path.suffix.lower() == ".toml" else f"expected {kind} (.toml)"
        if b"\\" in content:
            advice += ", and write / in place of \\ in names of files"
        raise error(f"{path}: is not TOML: {cause}; {advice}") from cause
