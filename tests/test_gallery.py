"""The gallery of the documentation: its page is what its script writes, and the script resumes."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from docs.make_gallery import section
from tests import ROOT

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


@pytest.mark.statistics
def test_a_quick_gallery_is_made_once(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--quick", "--work", str(tmp_path / "work"), "--out", str(tmp_path)]
    first = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    assert "grape.h5: building" in first.stderr
    assert "## Grape" in (tmp_path / "gallery.md").read_text(encoding="utf-8")
    assert (tmp_path / "gallery" / "grape.webp").is_file()
    again = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    assert "building" not in again.stderr
