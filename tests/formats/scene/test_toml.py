"""Text of scene and lights files: encodings and backslashes."""

from pathlib import Path

import pytest

from formats.errors import LightError, SceneError
from formats.scene.toml import read_toml

SCENE = '[object]\n# Größe\nmesh = "ball.ply"\n'


def test_tables_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(SCENE, "utf-8")
    assert read_toml(tmp_path / "a.toml", SceneError, "a scene file") == {"object": {"mesh": "ball.ply"}}


def test_other_encodings_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(SCENE, "cp1252")
    with pytest.raises(SceneError, match=r"a\.toml: is not a scene file: .* the byte 0xf6 in line 2, .*encoding UTF-8"):
        read_toml(path, SceneError, "a scene file")
    path.write_text(SCENE, "utf-16-le")
    with pytest.raises(LightError, match=r"a\.toml: is not a lights file: .* or UTF-16; save it as UTF-8"):
        read_toml(path, LightError, "a lights file")


def test_backslashes_and_other_kinds_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('mesh = "C:\\Users\\ball.ply"')
    with pytest.raises(SceneError, match=r"is not TOML: .*\(at line 1, .*correct the line, and write / in place of"):
        read_toml(tmp_path / "a.toml", SceneError, "a scene file")
    (tmp_path / "a.obj").write_text("v 0 0 0")
    with pytest.raises(SceneError, match=r"a\.obj: is not TOML: .*; expected a scene file \(\.toml\)$"):
        read_toml(tmp_path / "a.obj", SceneError, "a scene file")
