"""What a report made is made once, and again only for other inputs."""

import json
from pathlib import Path

import pytest

from formats.errors import StorageError
from prt_bake.paper.artefacts import Artefacts, Stopped


class Work:
    """Writes a file and counts how often."""

    def __init__(self, text: str = "made") -> None:
        self.text, self.times = text, 0

    def __call__(self, path: Path) -> dict[str, object]:
        self.times += 1
        path.write_text(self.text)
        return {"walks": 7}


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def artefacts(tmp_path: Path, said: list[str]) -> Artefacts:
    return Artefacts(tmp_path / "out", said.append)


def test_work_is_done_once_for_the_same_inputs(artefacts: Artefacts, said: list[str]) -> None:
    work = Work()
    first = artefacts.make("a/b.txt", {"spp": 4, "bins": (2, 3)}, work)
    again = artefacts.make("a/b.txt", {"bins": [2, 3], "spp": 4}, work)
    assert work.times == 1
    assert again == first
    assert again.facts["walks"] == 7
    assert again.facts["seconds"] >= 0.0
    assert said == ["a/b.txt: to be made"]


def test_another_input_is_another_work_and_the_reason_is_said(artefacts: Artefacts, said: list[str]) -> None:
    artefacts.make("b.txt", {"spp": 4, "seed": 0}, Work())
    work = Work("other")
    found = artefacts.make("b.txt", {"spp": 8, "seed": 0, "size": 1}, work)
    assert (work.times, found.path.read_text()) == (1, "other")
    assert said[-1] == "b.txt: made anew, another size, spp"


def test_a_file_that_was_altered_or_lost_is_made_anew(artefacts: Artefacts, said: list[str]) -> None:
    work = Work()
    made = artefacts.make("b.txt", {}, work)
    made.path.write_text("altered")
    assert artefacts.make("b.txt", {}, work).path.read_text() == "made"
    assert said[-1] == "b.txt: made anew, the file was altered"
    made.path.unlink()
    artefacts.make("b.txt", {}, work)
    made.path.with_name("b.txt.made.json").write_text(json.dumps({"inputs": {}}))
    artefacts.make("b.txt", {}, work)
    assert work.times == 4


def test_work_that_fails_leaves_nothing_to_be_taken_for_done(artefacts: Artefacts) -> None:
    def failing(path: Path) -> None:
        path.write_text("half")
        raise RuntimeError

    with pytest.raises(RuntimeError):
        artefacts.make("b.txt", {}, failing)
    assert artefacts.find("b.txt", {}) is None


def test_what_is_there_is_given_after_a_stop_and_nothing_else_begun(tmp_path: Path) -> None:
    asked = [False]
    artefacts = Artefacts(tmp_path, lambda sentence: None, lambda: asked[0])
    work = Work()
    artefacts.make("b.txt", {}, work)
    asked[0] = True
    artefacts.make("b.txt", {}, work)
    with pytest.raises(Stopped, match="goes on"):
        artefacts.make("c.txt", {}, work)
    assert work.times == 1


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"file/out: cannot be made"):
        Artefacts(tmp_path / "file" / "out", print)
