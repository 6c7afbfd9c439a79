"""Texts of files, for messages."""

_LONGEST = 60


def printable(text: str) -> str:
    """Return a text of a file in one line of at most 60 characters, without control characters."""
    kept = "".join(letter if letter.isprintable() else "?" for letter in text[: _LONGEST + 1])
    return kept if len(kept) <= _LONGEST else f"{kept[: _LONGEST - 1]}…"
