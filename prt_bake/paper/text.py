"""Text files of the report, and Markdown tables."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from formats.atomic import replacing


def write_text(path: Path, text: str) -> None:
    """Write a text file, atomically."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table.

    >>> print(markdown_table(("a", "b"), [("1", "2")]))
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    head = [f"| {' | '.join(columns)} |", f"|{'|'.join('---' for _ in columns)}|"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])
