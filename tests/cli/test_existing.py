"""Files that took minutes are replaced only with --force, and continued with --resume."""

from pathlib import Path

import pytest

from prt_bake.cli.main import main
from tests.cli.command_line import Outcome, Run

LINES = {
    "train none.toml -o a.pt": "a.pt a.train.pt a.importance.pt",
    "bake none.pt none.ply -o a.h5": "a.h5",
    "sample none.toml -o a.h5 --count 1": "a.h5",
    "importance model.pt none.ply": "model.importance.pt",
    "lobes model.pt asset.h5 -o a.h5": "a.h5",
    "compress asset.h5": "asset.compact.h5",
}
RESUMED = ("train",)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Return a function that runs a command line in a folder of empty inputs."""

    def run(line: str) -> Outcome:
        return Outcome(main(line.split()), *capsys.readouterr())

    monkeypatch.chdir(tmp_path)
    for name in ("model.pt", "asset.h5"):
        Path(name).write_text("")
    return run


@pytest.mark.parametrize(("line", "name"), [(line, name) for line, names in LINES.items() for name in names.split()])
def test_an_existing_file_is_refused_before_anything_is_read(run: Run, line: str, name: str) -> None:
    Path(name).write_text("minutes of work")
    outcome = run(line)
    more = ", or --resume to continue" if line.split()[0] in RESUMED else ""
    assert outcome == (1, "", f"prtbake: {name}: already exists; add --force to replace it{more}\n")
    assert "already exists" not in run(f"{line} --force").err
    assert Path(name).read_text() == "minutes of work"


def test_the_blocks_of_a_bake_that_was_killed_are_kept(run: Run) -> None:
    line = "bake none.pt none.ply -o a.h5"
    Path("a.h5.journal").mkdir()
    assert "already exists" not in run(line).err
    Path("a.h5.journal/0.npz").write_text("")
    sentence = "prtbake: a.h5.journal: already exists; add --force to replace it, or --resume to continue\n"
    assert run(line).err == sentence
    for option in ("--force", "--resume", "--dry-run"):
        assert "already exists" not in run(f"{line} {option}").err


def test_a_bake_that_has_nothing_to_resume_keeps_the_asset(run: Run) -> None:
    Path("a.h5").write_text("minutes of work")
    outcome = run("bake none.pt none.ply -o a.h5 --resume")
    assert outcome.err == "prtbake: a.h5: already exists; add --force to replace it\n"


def test_pictures_and_demonstrations_are_replaced(prtbake: Run, tmp_path: Path) -> None:
    for _ in range(2):
        picture = ("-o", tmp_path / "a.png", "--size", "4x4")
        assert prtbake("shade", "asset.h5", "--light", "sky.exr", *picture).code == 0
