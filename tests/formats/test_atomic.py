"""Atomic writes: errors, full disks and killed processes leave the older file unchanged."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from formats import atomic
from formats.atomic import create_folder, existing, remove_parts, replacing, sha256, temporary_path
from formats.errors import ImageError, StorageError
from formats.image import write_image


def test_the_new_file_replaces_the_old(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with replacing(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
        assert part.parent == tmp_path
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_symbolic_link_stays_a_link(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with replacing(tmp_path / "link") as part:
        part.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt(), OSError(errno.ENOENT, "x")])
def test_an_exception_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write_half() -> None:
        with replacing(path) as part:
            part.write_text("half")
            raise error

    with pytest.raises(type(error)):
        write_half()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_full_disk_is_reported_in_one_sentence(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def full(part: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(atomic, "_flush", full)
    with pytest.raises(StorageError, match=r"a\.txt: cannot be written: the disk is full"), replacing(path) as part:
        part.write_text("new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_temporary_file_that_another_program_removed_is_reported(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(StorageError, match=r"a\.txt: cannot be written: its temporary file"), replacing(path) as part:
        part.unlink()
    assert path.read_text() == "old"


def test_unusable_paths_are_refused_before_writing(tmp_path):
    for path, sentence in ((tmp_path / "no" / "a.txt", "folder .*no does not exist"), (tmp_path, "it is a folder")):
        with pytest.raises(StorageError, match=sentence), replacing(path):
            pytest.fail("the block must not be entered")
    with pytest.raises(StorageError, match="device"), replacing("/dev/null"):
        pytest.fail("the block must not be entered")


def test_folders_that_cannot_be_created_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="file: expected a folder, found a file; choose another folder"):
        create_folder(tmp_path / "file")
    with pytest.raises(StorageError, match="file/a: cannot be written: Not a directory; choose another folder"):
        create_folder(tmp_path / "file" / "a")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(StorageError, match="a: cannot be written: the disk is full; free some space"):
        create_folder(tmp_path / "a")


def test_missing_files_and_folders_cannot_be_read(tmp_path):
    with pytest.raises(StorageError, match="no such file"):
        existing(tmp_path / "a")
    with pytest.raises(StorageError, match="is a folder"):
        existing(tmp_path)
    with pytest.raises(StorageError, match=r"'a\\x00b' is no name of a file: embedded null byte"):
        existing("a\0b")


def test_sha256_of_known_bytes(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    assert sha256(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_a_killed_process_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    program = (
        "import os, signal, sys\nfrom formats.atomic import replacing\n"
        "with replacing(sys.argv[1]) as part:\n    part.write_text('half')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert path.read_text() == "old"


@pytest.mark.parametrize("name", ["絵" * 81, "𝔸" * 63, "[a]" * 80])
def test_the_longest_names_are_written_and_their_temporary_files_found(tmp_path: Path, name: str) -> None:
    with replacing(tmp_path / name) as part:
        part.write_text("new")
    temporary_path(tmp_path / name).touch()
    remove_parts(tmp_path, name)
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".png"])
def test_images_beyond_the_size_limit_keep_the_old_file(tmp_path, suffix):
    import resource

    path = tmp_path / f"a{suffix}"
    path.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(StorageError, match="cannot be written"):
            write_image(path, np.random.default_rng(1).random((64, 64, 3)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == [path.name]


def test_an_invalid_image_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.hdr"
    path.write_text("old")
    with pytest.raises(ImageError, match="row 0, column 1"):
        write_image(path, np.array([[[1, 1, 1], [1, np.inf, 1]]], np.float32))
    assert path.read_text() == "old"


def test_names_that_lost_a_backslash_are_shown(tmp_path):
    for name, shown in (("meshes\test.obj", r"meshes\\test\.obj"), ("a\bc", r"a\\x08c"), ("a\\b", r"a\\b")):
        with pytest.raises(StorageError, match=f"{shown}: there is no such file; write / in place of "):
            existing(tmp_path / name)
