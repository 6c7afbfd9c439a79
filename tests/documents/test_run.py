"""Pages are run in an empty folder; state is kept between blocks, and failures are reported with their output."""

import sys
from pathlib import Path

import pytest

from tests.documents import run
from tests.documents.run import run_page, shortened


def write(folder: Path, text: str) -> Path:
    page = folder / "page.md"
    page.write_text(text, encoding="utf-8")
    return page


def test_blocks_share_a_folder_and_the_names_of_python(tmp_path: Path) -> None:
    page = write(
        tmp_path,
        """<!-- run: mkdir inner; echo 1 > inner/one.txt -->
```sh
test ! -e page.md; cd inner
```
```python
one = int(open("one.txt").read())
```
```sh
test -s one.txt
prtbake --version
```
```python
assert one == 1
```
<!-- not run: hours -->
```sh
false
```
```text
false
```
""",
    )
    result = run_page(page)
    assert result.failures == []
    assert (result.run, result.not_run) == (5, ["hours"])


def test_failures_have_the_line_the_code_and_the_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = write(tmp_path, "```sh\necho before\nfalse\necho after\n```\n```python\nx = 1\nraise KeyError(x)\n```\n")
    monkeypatch.setattr(sys, "argv", ["run", str(page)])
    assert run.main() == 1
    out = capsys.readouterr().out
    assert "page.md:2\n    | echo before\n    | false\n    | echo after\n    | \n    | before\n    | (failed)" in out
    assert 'page.md", line 8, in <module>\n    |     raise KeyError(x)' in out
    assert "2 blocks failed" in out


def test_a_process_that_ends_fails_its_block_alone(tmp_path: Path) -> None:
    page = write(tmp_path, "```python\nimport os; os._exit(3)\n```\n```sh\ntrue\n```\n")
    (failure,) = run_page(page).failures
    assert failure.endswith("the process ended; the blocks below it were not run")


def test_a_block_that_takes_too_long_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "MOST_SECONDS", 0.1)
    (failure,) = run_page(write(tmp_path, "```python\nimport time; time.sleep(60)\n```\n")).failures
    assert "still running after 0.1 s" in failure


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (
            "prtbake train a --minutes 20 -o b\nprtbake bake --minutes 0.5",
            "prtbake train a --minutes 1 -o b\nprtbake bake --minutes 0.5",
        ),
        ("prtbake make a \\\n  --minutes=20", "prtbake make a    --minutes=2"),
        ("prt.bake(a, minutes=5.5)", "prt.bake(a, minutes=1)"),
    ],
)
def test_minutes_are_few(code: str, expected: str) -> None:
    assert shortened(code) == expected
