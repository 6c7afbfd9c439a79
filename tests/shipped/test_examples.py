"""The examples by name, and the command that copies them."""

import filecmp
from pathlib import Path

import pytest

import prt_bake as prt
from prt_bake.shipped.examples import NAMES
from tests.cli.command_line import Run


@pytest.mark.parametrize("name", NAMES)
def test_every_example_is_a_file(name: str) -> None:
    assert prt.example(name).is_file()


def test_an_unknown_example_is_refused_with_all_names() -> None:
    with pytest.raises(prt.PrtbakeError, match=f"'cow.obj'; expected one of {', '.join(NAMES)}"):
        prt.example("cow.obj")


def test_the_command_copies_a_scene_that_is_sound(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = prtbake("example", tmp_path / "my spot")
    assert outcome.code == 0, outcome.err
    assert outcome.out.splitlines() == [str(tmp_path / "my spot" / name) for name in NAMES]
    assert all(filecmp.cmp(prt.example(name), tmp_path / "my spot" / name, shallow=False) for name in NAMES)
    first, *others = outcome.err.splitlines()
    assert first == f"next: cd '{tmp_path}/my spot'"
    assert all(line.startswith("next: prtbake ") for line in others)
    monkeypatch.chdir(tmp_path / "my spot")
    assert prtbake("check", "spot.toml").code == 0
    again = prtbake("example", tmp_path / "my spot")
    assert again.err == f"prtbake: {tmp_path}/my spot/spot.toml: already exists; choose a new folder for the example\n"
