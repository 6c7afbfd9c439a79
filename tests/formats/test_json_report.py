"""Reports as JSON: what is written is what is read, a list of numbers is one line, and nothing writes NaN."""

import ast
import json
from collections.abc import Iterator

from hypothesis import given, settings
from hypothesis import strategies as st

from formats.json_report import as_line, as_text
from tests import ROOT

_NUMBERS = st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.none() | st.booleans()
_VALUES = st.recursive(
    _NUMBERS | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@settings(max_examples=40)
@given(st.dictionaries(st.text(), _VALUES))
def test_a_report_is_read_back_as_it_was(report: dict[str, object]) -> None:
    assert json.loads(as_text(report)) == report


def test_texts_that_look_like_lists_stay_as_they_are() -> None:
    report = {"text": "[\n  1,\n  2\n]", "texts": ["[\n1]", "]"], "mixed": [1, "a"]}
    assert json.loads(as_text(report)) == report


def test_every_list_of_numbers_is_one_line() -> None:
    text = as_text({"rows": [[1, 2.5, -3e-9], [4, float("nan"), float("inf")]]})
    assert text.splitlines()[2:4] == ["    [1, 2.5, -3e-09],", "    [4, null, null]"]


def test_unknown_numbers_in_one_line_are_null() -> None:
    assert as_line({"a": [1, float("nan")], "b": (float("-inf"), 2.5)}) == '{"a": [1, null], "b": [null, 2.5]}'


def writers_of_nan() -> Iterator[str]:
    """Yield the file and line of each call of json.dump or json.dumps that can write NaN, which JSON does not have."""
    for path in (path for room in ("formats", "bakers", "prt_bake", "docs") for path in (ROOT / room).rglob("*.py")):
        if "dump" not in (text := path.read_text(encoding="utf-8")):
            continue
        calls = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
        for call in (call for call in calls if ast.unparse(call.func) in ("json.dump", "json.dumps")):
            if "allow_nan=False" not in map(ast.unparse, call.keywords):
                yield f"{path.relative_to(ROOT)}:{call.lineno}"


def test_no_json_can_hold_nan() -> None:
    assert list(writers_of_nan()) == []
