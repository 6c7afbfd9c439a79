"""What every command line of a shell has: a version, help, completion, verbosity, exit codes."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import prt_bake as prt
from formats.errors import warn
from prt_bake.cli.main import COMMANDS
from prt_bake.cli.shared.progress import stopping
from tests.cli.command_line import Run


def test_the_version(prtbake: Run) -> None:
    assert prtbake("--version").out == f"prtbake {prt.__version__}\n"
    assert re.match(r"\d+\.\d+", prt.__version__)


@pytest.mark.parametrize("words", [(), ("shade",), ("report",), ("report", "bake")])
def test_h_is_help(prtbake: Run, words: tuple[str, ...]) -> None:
    assert prtbake(*words, "-h") == prtbake(*words, "--help")
    assert prtbake(*words, "-h").code == 0


def test_the_list_of_commands_begins_with_the_main_ones_and_cuts_no_sentence(
    prtbake: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = prtbake("--help").out
    assert max(map(len, text.splitlines())) <= 80
    assert "..." not in text.partition("\n")[2]
    listed = re.findall(r"^  ([a-z]+)  ", text, re.MULTILINE)
    assert {"demo", "train", "bake", "shade", "view"} <= set(listed[:9])
    assert {*listed} == {"report", *(name for group in COMMANDS.values() for name in group)}
    assert prtbake().err == text  # wrong usage, but with the same words
    joined = " ".join(text.split())
    for group in COMMANDS.values():
        for command in group.values():
            assert " ".join((command.__doc__ or "").partition("\n\n")[0].split()) in joined


def _completed(shell: str, line: str) -> list[str]:
    words = line.split(" ")
    names = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1), "_TYPER_COMPLETE_ARGS": line}
    more = {"_PRTBAKE_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    ran = subprocess.run(
        [sys.executable, "-m", "prt_bake"], env=os.environ | names | more, capture_output=True, text=True, check=True
    )
    return ran.stdout.split()


def test_names_and_options_complete_and_files_are_left_to_the_shell() -> None:
    assert _completed("bash", "prtbake sh") == ["shade"]
    assert "--samples" in _completed("fish", "prtbake bake --sam")
    assert _completed("zsh", "prtbake bake spo") == ["_files"]
    assert _completed("bash", "prtbake bake model.pt sphere.ply -o ") == []


def test_values_complete_as_a_shell_takes_them() -> None:
    assert _completed("bash", "prtbake init a.obj --material wh") == [
        *("white-jade", "whole-milk", "white-zinfandel", "white-grapefruit-juice")
    ]
    assert _completed("fish", "prtbake make a.obj --material head") == ["head-shoulders-shampoo"]
    assert _completed("fish", "prtbake shade a.h5 --view three") == ["three-quarter", "three-quarter-back"]


def test_the_completion_of_a_shell_can_be_shown_and_installed() -> None:
    options = [line.split()[0] for line in _help().splitlines() if "completion" in line and line.startswith("  --")]
    assert options == ["--install-completion", "--show-completion"]


def _help() -> str:
    return subprocess.run(
        [sys.executable, "-m", "prt_bake", "--help"], capture_output=True, text=True, check=True
    ).stdout


@pytest.mark.parametrize("place", ["before", "after"])
def test_verbose_names_versions_and_the_origin_of_messages(
    prtbake: Run, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.setattr("prt_bake.inspection.files.describe", lambda path: warn(f"{path}: a remark") or {"kind": "x"})
    monkeypatch.setattr("prt_bake.jit.notice.compiled", [("a", 1.0), ("b", 0.5)])
    words = ("-v", "info", "scene.toml", "--all") if place == "before" else ("info", "scene.toml", "--all", "--verbose")
    plain, verbose = prtbake("info", "scene.toml", "--all"), prtbake(*words)
    assert (verbose.code, verbose.out) == (0, plain.out)
    assert plain.err == "prtbake: warning: scene.toml: a remark\n"
    first, *_, origin, compilation, last = verbose.err.splitlines()
    assert first.startswith(f"prtbake: prtbake {prt.__version__}, Python 3.")
    assert "numpy " in first
    assert Path(__file__).name in origin
    assert compilation == "prtbake: compiled kernels in 1.5 s"
    assert last.endswith(" s in all")


def test_verbose_prints_where_an_error_was_raised(prtbake: Run) -> None:
    assert "Traceback" in prtbake("info", "none.toml", "-v").err
    assert "Traceback" not in prtbake("info", "none.toml").err


def test_verbose_is_no_option_behind_two_dashes(prtbake: Run) -> None:
    assert prtbake("info", "--", "-v").err == "prtbake: -v: there is no such file; check the name and the folder\n"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_command_that_keeps_what_it_has_ends_as_shells_expect(
    prtbake: Run, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, code: int
) -> None:
    def stopped(path: Path) -> dict[str, str]:
        with stopping() as stop:
            signal.raise_signal(number)
            assert stop()
        return {}

    monkeypatch.setattr("prt_bake.inspection.files.describe", stopped)
    assert prtbake("info", "scene.toml", "--json").code == code
    assert prtbake("light", "sky.exr").code == 0


def test_ctrl_c_that_no_command_catches_is_130(prtbake: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("prt_bake.inspection.files.describe", interrupted)
    outcome = prtbake("info", "scene.toml")
    assert (outcome.code, outcome.err) == (130, "prtbake: stopped by Ctrl-C before it was finished\n")
