"""The gallery of the documentation: its page is what its script writes, and the script resumes."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import prt_bake as prt
from docs.live_page import BACK, marked, write_live
from docs.make_gallery import section
from prt_bake.inspection.files import find_faults
from tests import ROOT
from tests.export.conftest import small_page

SCRIPT, GALLERY = ROOT / "docs" / "make_gallery.py", ROOT / "docs" / "gallery"


def test_the_page_is_what_the_script_writes() -> None:
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    scenes = tomllib.loads((GALLERY / "gallery.toml").read_text(encoding="utf-8"))["scene"]
    made = json.loads((GALLERY / "figures.json").read_text(encoding="utf-8"))["scenes"]
    assert [each["name"] for each in made] == [each["name"] for each in scenes]
    assert page == "\n".join([(GALLERY / "head.txt").read_text(encoding="utf-8"), *map(section, made)])
    for each in scenes:
        assert (ROOT / each["scene"]).is_file()
        assert (GALLERY / f"{each['name']}.webp").stat().st_size < 400_000


def test_assets_of_the_live_page_are_small_and_sound() -> None:
    live = sorted((GALLERY / "live").iterdir())
    scenes = tomllib.loads((GALLERY / "gallery.toml").read_text(encoding="utf-8"))["scene"]
    assert {path.stem for path in live} == {each["name"] for each in scenes if each.get("live", True)}
    assert max(path.stat().st_size for path in live) <= 1_000_000
    assert sum(path.stat().st_size for path in live) <= 5_000_000
    assert [fault for path in live for fault in find_faults(path)] == []
    assert not [path for path in live if re.search(r'["\s][/\\]\w|\w:\\', str(prt.read_asset(path).provenance))]


def test_the_live_page_shows_them_under_its_lights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = small_page(tmp_path, monkeypatch)
    assert write_live(tmp_path / "live")
    described = json.loads((tmp_path / "live" / "site.json").read_text(encoding="utf-8"))
    assert described["objects"][0] == {"name": "Spot in marble", "file": "Spot_in_marble.h5", "from": BACK}
    assert len(described["objects"]) == len(list((GALLERY / "live").iterdir()))
    assert len(described["lights"]) == 3
    (page / "vendor" / "VERSIONS").unlink()
    assert not write_live(tmp_path / "live")
    assert not (tmp_path / "live").exists()
    assert "run `make site`" in capsys.readouterr().err
    assert marked() == ["gallery", "index"]


@pytest.mark.statistics
def test_a_quick_gallery_is_made_once(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--quick", "--work", str(tmp_path / "work"), "--out", str(tmp_path)]
    first = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    assert "grape.h5: building" in first.stderr
    assert "## Grape" in (tmp_path / "gallery.md").read_text(encoding="utf-8")
    assert (tmp_path / "gallery" / "grape.webp").is_file()
    assert (tmp_path / "gallery" / "live" / "grape.h5").is_file()
    again = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    assert "building" not in again.stderr
