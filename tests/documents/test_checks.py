"""What is wrong on made-up pages is found, and what is right is not."""

from pathlib import Path

import pytest

from tests.documents.checks import command_faults, file_faults, link_faults, long_lines, python_faults


@pytest.mark.parametrize(
    "text",
    [
        "```sh\nprtbake shade spot.h5 --light sky.hdr --size 256x256 -o spot.png\n```",
        "<!-- not run: a window -->\n```sh\nprtbake view spot.h5 -v && make lint\n```",
        "```sh\nprtbake --version\nprtbake bake --help\n```",
        "`prtbake bake … --error 0.01`, `prtbake COMMAND --help`, `prtbake report bake`, `--spp`, `prtbake`",
        "`make docs-commands`, `make shipped SKY=sky.hdr`, `python -m tests.bench.NAME`",
        "`python -m tests.bench.frames`, `-m scenes.make`",
    ],
)
def test_right_commands(text: str) -> None:
    assert command_faults(text) == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("```sh\nprtbake shade spot.h5 --lihgt sky.hdr -o spot.png\n```", "No such option: --lihgt"),
        ("```sh\n# a comment\nprtbake shine spot.h5\n```", "there is no command shine"),
        ("```sh\nprtbake bake a.pt a.obj -o a.h5 --samples many\n```", "valid integer"),
        ("```sh\nprtbake bake a.pt a.obj b.obj -o a.h5\n```", "unexpected extra argument"),
        ("<!-- not run: hours -->\n```sh\ncd x && prtbake train\\\n  s.toml -o s.pt --hours 3\n```", "--hours"),
        ("```sh\necho 'open\n```", "the shell cannot read it"),
        ("```sh\nmake everything\n```", "no target everything"),
        ("`prtbake shade … --lihgt`", "has no option --lihgt"),
        ("`prtbake shine`", "no command shine"),
        ("`--lihgt`", "no command has this option"),
        ("`make everything`", "no target everything"),
        ("```sh\npython -m tests.bench.nothing --help\n```", "no such module"),
        ("`python -m scenes.nothing`", "no such module"),
    ],
)
def test_wrong_commands(text: str, fault: str) -> None:
    (found,) = command_faults(text)
    assert fault in found


def test_python() -> None:
    assert python_faults("```python\nimport prt_bake as prt\nprt.bake(prt.read_mesh('a.obj'))\n```") == []
    assert python_faults("text\n```python\nx = prt.bakes()\n```") == ["line 3: there is no prt.bakes"]
    assert python_faults("```python\nx = (\n```") == ["line 2: '(' was never closed"]


def test_files() -> None:
    assert file_faults("`prt_bake/cli/main.py`, `tests/`, `scenes/SCENE.toml`, `docs/*/errors.md`, [x](tests/no)") == []
    assert file_faults("`python tests/no.py`") == ["`tests/no.py`: there is no such file"]


def test_links(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# Other\n## A `b`: c, [d](e.md)\n## Twice\n## Twice\n", encoding="utf-8")
    page = tmp_path / "page.md"
    right = "[a](other.md) [b](other.md#a-b-c-d) [c](other.md#twice-1) [d](#page) [e](https://example.org/no)"
    page.write_text(f"# Page\n{right}\n```text\n[x](no.md)\n# No\n```\n", encoding="utf-8")
    assert link_faults(page) == []
    page.write_text('[a](no.md) [b](other.md#twice-2) ![c](no.png) <img src="none.png">', encoding="utf-8")
    assert [fault.partition(":")[0] for fault in link_faults(page)] == [
        "(no.md)",
        "(other.md#twice-2)",
        "(no.png)",
        "(none.png)",
    ]


def test_lines() -> None:
    assert long_lines("| " + "x" * 200 + "\n" + "Ŝ" * 150) == []
    assert long_lines("a\n" + "x" * 151) == ["line 2: 151 characters; expected at most 150"]
