"""`prtbake export ASSET... -o FOLDER`: the page of assets."""

import json
from pathlib import Path

import pytest

from tests.cli.command_line import Run
from tests.export.conftest import small_page


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return small_page(tmp_path, monkeypatch)


def test_assets_and_glb_files_become_a_page(page: Path, prtbake: Run, tmp_path: Path) -> None:
    glb, target = tmp_path / "engine.glb", tmp_path / "site"
    assert prtbake("export", "asset.h5", "-o", glb).code == 0
    outcome = prtbake("export", "asset.h5", glb, "-o", target, "--light", "sky.exr", "--light", "sun:0,1,0")
    assert outcome.code == 0, outcome
    assert "a page that any web server shows" in outcome.out
    assert outcome.err.splitlines()[-1] == f"next: python3 -m http.server --bind 127.0.0.1 --directory {target}"
    described = json.loads((target / "site.json").read_text())
    assert [each["file"] for each in described["objects"]] == ["asset.h5", "engine.glb"]
    assert [each["name"] for each in described["lights"]] == ["sky.exr", "sun:0,1,0"]
    again = prtbake("export", glb, "-o", target)
    assert (again.code, "add --force" in again.err) == (1, True)
    assert prtbake("export", glb, "-o", target, "--force").code == 0
    assert len(json.loads((target / "site.json").read_text())["objects"]) == 1


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["asset.h5", "-o", "site", "--degree", 3], 2, "--degree: has no effect on --to site"),
        (["asset.h5", "asset.h5", "-o", "x.glb"], 1, "only a site shows several"),
        (["asset.h5", "-o", "x.exe"], 1, "--to site if this is one"),
        (["scene.toml", "-o", "site", "--to", "site"], 1, "--to site does not take this kind of file, scene"),
        (["asset.h5", "sphere.ply", "-o", "site"], 1, "expected an asset or a scene (SOURCE), found a mesh"),
        (["asset.h5", "-o", "site", "--light", "none.exr"], 1, "none.exr"),
    ],
)
def test_errors_are_one_sentence(page: Path, prtbake: Run, words: list[object], code: int, message: str) -> None:
    outcome = prtbake("export", *words)
    assert outcome.code == code
    assert message in outcome.err
    assert not Path("site").exists()
