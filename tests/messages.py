"""Prints every message of an error or a warning in the source, by file: `make messages`.

A good message says in one sentence: which file, where in it, what was expected, what was found, what to do. Parts of
messages, which functions return, yield or append to a list, are printed too.
"""

import ast
from collections.abc import Iterator

from tests import ROOT

PACKAGES = ("formats", "bakers", "prt_bake")
CALLS = ("warn", "say", "append")
PART = "part"
"""The kind of a text that a function returns or yields."""
LEAST_WORDS = 3
"""Parts of fewer words are names."""


def main() -> None:
    """Print each file with messages, then a line per message: line number, class, text."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            found = list(messages(path.read_text(encoding="utf-8")))
            if found:
                print(path.relative_to(ROOT))
            for line, kind, text in found:
                print(f"  {line}: {kind}: {text}")


def messages(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield (line, class or function, text) of each message or part of one, in the source's order.

    A placeholder of an f-string becomes the expression in braces.
    """
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt | ast.expr)]
    for node in sorted(nodes, key=lambda node: (node.lineno, node.col_offset)):
        kind, texts = _texts(node)
        if texts and (kind.endswith("Error") or len(texts[0].split()) >= LEAST_WORDS):
            yield node.lineno, kind, "; ".join(texts)


def _texts(node: ast.AST) -> tuple[str, list[str]]:
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        kind, values = _name(node.exc), list(node.exc.args)
    elif isinstance(node, ast.Call) and _name(node) in CALLS:
        kind, values = _name(node), list(node.args)
    elif isinstance(node, ast.Return | ast.Yield) and node.value is not None:
        kind, values = PART, [node.value]
    else:
        return "", []
    return kind, [text for value in values if (text := _text(value))]


def _name(call: ast.Call) -> str:
    function = call.func
    return function.attr if isinstance(function, ast.Attribute) else ast.unparse(function)


def _text(node: ast.expr) -> str:
    """The text of an expression with its placeholders in braces; "" if it holds no text."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            _text(part) if isinstance(part, ast.Constant) else f"{{{ast.unparse(part.value)}}}"
            for part in node.values
            if isinstance(part, ast.Constant | ast.FormattedValue)
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + _text(node.right)
    return ""


if __name__ == "__main__":
    main()
