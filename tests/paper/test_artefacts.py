"""Artefacts are built once, and rebuilt only for changed inputs."""

import json
import math
from pathlib import Path

import pytest

from formats.errors import StorageError
from prt_bake.paper.artefacts import Artefacts, Stopped


class Work:
    """Writes a file and counts the calls."""

    def __init__(self, text: str = "made") -> None:
        self.text, self.times = text, 0

    def __call__(self, path: Path) -> dict[str, object]:
        self.times += 1
        path.write_text(self.text)
        return {"walks": 7}


@pytest.fixture
def messages() -> list[str]:
    return []


@pytest.fixture
def artefacts(tmp_path: Path, messages: list[str]) -> Artefacts:
    return Artefacts(tmp_path / "out", messages.append)


def test_files_are_built_once_for_the_same_inputs(artefacts: Artefacts, messages: list[str]) -> None:
    work = Work()
    first = artefacts.make("a/b.txt", {"spp": 4, "bins": (2, 3)}, work)
    again = artefacts.make("a/b.txt", {"bins": [2, 3], "spp": 4}, work)
    assert work.times == 1
    assert again == first
    assert again.facts["walks"] == 7
    assert set(again.facts) >= {"walks", "seconds"}
    assert messages == ["a/b.txt: building"]


def test_changed_inputs_rebuild_the_file(artefacts: Artefacts, messages: list[str]) -> None:
    artefacts.make("b.txt", {"spp": 4, "seed": 0}, Work())
    work = Work("other")
    found = artefacts.make("b.txt", {"spp": 8, "seed": 0, "size": 1}, work)
    assert (work.times, found.path.read_text()) == (1, "other")
    assert messages[-1] == "b.txt: rebuilding, changed size, spp"


def test_an_altered_or_missing_file_is_rebuilt(artefacts: Artefacts, messages: list[str]) -> None:
    work = Work()
    made = artefacts.make("b.txt", {}, work)
    made.path.write_text("altered")
    assert artefacts.make("b.txt", {}, work).path.read_text() == "made"
    assert messages[-1] == "b.txt: rebuilding, the file was altered"
    made.path.unlink()
    artefacts.make("b.txt", {}, work)
    made.path.with_name("b.txt.made.json").write_text(json.dumps({"inputs": {}}))
    artefacts.make("b.txt", {}, work)
    assert work.times == 4


def test_unknown_facts_are_null_in_the_record_and_none_when_read(artefacts: Artefacts) -> None:
    def build(path: Path) -> dict[str, object]:
        path.write_text("made")
        return {"ssim": math.nan, "flips": [0.5, math.inf]}

    first = artefacts.make("b.txt", {}, build)
    record = first.path.with_name("b.txt.made.json")
    assert json.loads(record.read_text(), parse_constant=pytest.fail)["facts"]["ssim"] is None
    assert (first.facts["ssim"], first.facts["flips"]) == (None, [0.5, None])
    assert artefacts.find("b.txt", {}) == first
    record.write_text(record.read_text().replace("null", "NaN"))  # as earlier versions wrote it
    assert artefacts.find("b.txt", {}) == first


def test_a_failed_build_leaves_no_record(artefacts: Artefacts) -> None:
    def failing(path: Path) -> None:
        path.write_text("half")
        raise RuntimeError

    with pytest.raises(RuntimeError):
        artefacts.make("b.txt", {}, failing)
    assert artefacts.find("b.txt", {}) is None


def test_existing_files_are_returned_after_a_stop_and_no_others_are_built(tmp_path: Path) -> None:
    stop = [False]
    artefacts = Artefacts(tmp_path, lambda sentence: None, lambda: stop[0])
    work = Work()
    artefacts.make("b.txt", {}, work)
    stop[0] = True
    artefacts.make("b.txt", {}, work)
    with pytest.raises(Stopped, match="resumes"):
        artefacts.make("c.txt", {}, work)
    assert work.times == 1


def test_a_folder_that_cannot_be_created_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"file/out: cannot be written"):
        Artefacts(tmp_path / "file" / "out", print)
