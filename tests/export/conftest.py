"""A page without the npm packages, for tests of what is written and served around it."""

from pathlib import Path

import pytest

from prt_bake.export import site


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small page, which takes the place of the real one."""
    return small_page(tmp_path, monkeypatch)


def small_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a page of four files and one that is not part of it."""
    folder = tmp_path / "page"
    (folder / "vendor" / "three").mkdir(parents=True)
    for name in ("index.html", "view.js", "package.json", "vendor/VERSIONS", "vendor/three/three.module.js"):
        (folder / name).write_text(name)
    monkeypatch.setattr(site, "PAGE", folder)
    return folder
