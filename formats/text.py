"""Text of files: byte order marks (Unicode standard, section 23.8), and texts in messages."""

import codecs
import os

from formats.errors import FormatError

_OTHER_ENCODINGS = {  # UTF-32 first: its mark begins with that of UTF-16
    codecs.BOM_UTF32_LE: "UTF-32",
    codecs.BOM_UTF32_BE: "UTF-32",
    codecs.BOM_UTF16_LE: "UTF-16",
    codecs.BOM_UTF16_BE: "UTF-16",
}
_LONGEST = 60


def without_byte_order_mark(content: bytes, path: str | os.PathLike[str], error: type[FormatError]) -> bytes:
    """Return the bytes of a UTF-8 file without its byte order mark; raises `error` for text in UTF-16 or UTF-32."""
    for mark, name in _OTHER_ENCODINGS.items():
        if content.startswith(mark):
            raise error(f"{path}: expected text in UTF-8, found {name}; save it again with the encoding UTF-8")
    return content.removeprefix(codecs.BOM_UTF8)


def printable(text: str, longest: int = _LONGEST) -> str:
    """Return a text of a file in one line of at most `longest` characters, without control characters, for messages."""
    kept = "".join(letter if letter.isprintable() else "?" for letter in text[: longest + 1])
    return kept if len(kept) <= longest else f"{kept[: longest - 1]}…"
