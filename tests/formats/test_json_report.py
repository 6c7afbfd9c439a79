"""Reports as JSON: what is written is what is read, and a list of numbers is one line."""

import json

from hypothesis import given
from hypothesis import strategies as st

from formats.json_report import as_text

_NUMBERS = st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.none() | st.booleans()
_VALUES = st.recursive(
    _NUMBERS | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(st.dictionaries(st.text(), _VALUES))
def test_a_report_is_read_back_as_it_was(report: dict[str, object]) -> None:
    assert json.loads(as_text(report)) == report


def test_texts_that_look_like_lists_stay_as_they_are() -> None:
    report = {"text": "[\n  1,\n  2\n]", "texts": ["[\n1]", "]"], "mixed": [1, "a"]}
    assert json.loads(as_text(report)) == report


def test_every_list_of_numbers_is_one_line() -> None:
    text = as_text({"rows": [[1, 2.5, -3e-9], [4, float("nan"), float("inf")]]})
    assert text.splitlines()[2:4] == ["    [1, 2.5, -3e-09],", "    [4, null, null]"]
