"""Numbers in text as some programs and countries write them."""

import re

_NAMED = re.compile(rb"([-+]?)(?:(nan\((?:ind|snan)\))|1\.#(?:(IND|QNAN|SNAN)|(INF))0*)(?!\w)")
_DECIMAL_COMMA = re.compile(rb"\d,\d")


def with_plain_nan(text: bytes) -> bytes:
    """Return text in which NaN and infinity of Microsoft's C library (`-nan(ind)`, `1.#QNAN`) are `nan` and `inf`."""
    if b"nan(" not in text and b"1.#" not in text:
        return text
    return _NAMED.sub(lambda found: found[1] + (b"inf" if found[4] else b"nan"), text)


def number_remedy(text: bytes) -> str:
    """Return what to do about text that is not a number: with decimal commas, or damaged."""
    if _DECIMAL_COMMA.search(text):
        return "its numbers have commas; export it again with decimal points"
    return "export the mesh again"
