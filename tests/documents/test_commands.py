"""How pages are read: blocks, reasons, hidden commands, and the words of shell commands."""

import pytest

from tests.documents.commands import Block, blocks, in_code_font, prtbake_arguments, simple_commands

PAGE = """# A page
<!-- run: cp a.txt b.txt -->
```sh
prtbake example spot && cd spot
```
Text with `code` and ``a ` in it``.

<!-- not run: needs a GPU -->

```python
print("`not a span`")
```
1. In a list:
   ```text
   output
   ```
"""


def test_blocks_are_read_in_order() -> None:
    assert blocks(PAGE) == [
        Block(1, "sh", "cp a.txt b.txt"),
        Block(3, "sh", "prtbake example spot && cd spot"),
        Block(10, "python", 'print("`not a span`")', "needs a GPU"),
        Block(14, "text", "output"),
    ]
    assert [block.runs for block in blocks(PAGE)] == [True, True, False, False]


def test_code_font_is_that_of_prose() -> None:
    assert in_code_font(PAGE) == ["code", "a ` in it"]


@pytest.mark.parametrize("text", ["```sh\nls\n", "<!-- not run: minutes -->\ntext\n", "<!-- not run: minutes -->\n"])
def test_pages_that_are_not_whole_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected a block below|has no end"):
        blocks(text)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("a -o 'b c'  # why", [["a", "-o", "b c"]]),
        ("a && b; c | d > e.txt", [["a"], ["b"], ["c"], ["d"]]),
        ("a \\\n  --b 1\n\nc", [["a", "--b", "1"], ["c"]]),
        ("X=1 a --rank $RANK --of ${N} --cores $(nproc)", [["a", "--rank", "1", "--of", "1", "--cores", "1"]]),
        ("a 2> log --b", [["a", "2", "--b"]]),
    ],
)
def test_scripts_are_split_into_simple_commands(script: str, words: list[list[str]]) -> None:
    assert simple_commands(script) == words


@pytest.mark.parametrize(
    ("words", "arguments"),
    [
        ("prtbake info a.obj", ["info", "a.obj"]),
        ("taskset -c 0 .venv/bin/prtbake demo", ["demo"]),
        ("python -m prt_bake info", ["info"]),
        ("mitsuba scene.xml", None),
    ],
)
def test_prtbake_is_found_behind_other_programs(words: str, arguments: list[str] | None) -> None:
    assert prtbake_arguments(words.split()) == arguments
