"""File names that other files hold, written on one system and read on another."""

import os
import unicodedata
from pathlib import Path


def named_file(path: str | os.PathLike[str], name: str) -> Path:
    """Return the file `name` relative to the folder of `path`, the file that names it.

    If there is none, but one whose name has the same letters in another Unicode normal form (as of macOS, which takes é
    apart), that one.
    """
    folder = Path(path).parent
    if not os.path.exists(folder / name):
        for other in (unicodedata.normalize("NFC", name), unicodedata.normalize("NFD", name)):
            if os.path.exists(folder / other):
                return folder / other
    return folder / name
