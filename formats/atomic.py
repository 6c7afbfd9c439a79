"""Atomic writes: a file grows under a temporary name beside the old one and is renamed when it is complete.

No library: python-atomicwrites is archived, and the messages for full and read-only disks are needed anyway.
"""

import contextlib
import errno
import glob
import hashlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from formats.errors import StorageError

_REASONS = {
    errno.ENOSPC: "the disk is full; free some space or write elsewhere",
    errno.EDQUOT: "the disk quota is used up; free some space or write elsewhere",
    errno.EFBIG: "the file grows beyond what the system allows; raise the limit or write elsewhere",
    errno.EACCES: "permission denied; choose a folder that you may write to",
    errno.EPERM: "permission denied; choose a folder that you may write to",
    errno.EROFS: "the disk is read-only; write elsewhere",
    errno.EIO: "the disk reports an input/output error; write elsewhere",
}
_KEPT = 60  # letters of a name in its temporary name: of 4 bytes each, they leave room for the rest within 255 bytes


def storage_error(path: str | os.PathLike[str], cause: OSError) -> StorageError:
    """Return the StorageError for an operating system's error while writing `path`."""
    reason = _REASONS.get(cause.errno or 0) or cause.strerror or str(cause)
    return StorageError(f"{path}: cannot be written: {reason}")


def refuse_unwritable(path: str | os.PathLike[str]) -> None:
    """Raise StorageError if `path` cannot be written: no such folder, a read-only folder, not an ordinary file."""
    target = Path(os.path.realpath(path))
    if target.parent.is_file():
        raise StorageError(f"{path}: cannot be written: {target.parent} is a file, not a folder; check the path")
    if not target.parent.is_dir():
        raise StorageError(f"{path}: cannot be written: the folder {target.parent} does not exist; create it first")
    if target.is_dir():
        raise StorageError(f"{path}: cannot be written: it is a folder; give the name of a file")
    if target.exists() and not target.is_file():
        raise StorageError(f"{path}: cannot be written: it is a device or a pipe; give the name of a file")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise StorageError(
            f"{path}: cannot be written: the folder {target.parent} is read-only for you; choose another folder"
        )


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; that file replaces `path` when the block ends without an exception.

    After any exception the temporary file is removed and an older file at `path` is unchanged. A killed process leaves
    the older file too, and a `.part` file beside it.

    Raises:
        StorageError: the folder is missing or was removed, `path` is not an ordinary file, the disk is full or
            read-only.
    """
    target = Path(os.path.realpath(path))
    refuse_unwritable(path)
    part = temporary_path(target)
    try:
        with open(part, "xb"):
            pass
        yield part
        if not part.exists():
            raise StorageError(
                f"{path}: cannot be written: its temporary file or its folder was removed meanwhile; write it again, "
                "by one program at a time"
            )
        _flush(part)
        os.replace(part, target)
    except OSError as cause:
        if isinstance(cause, StorageError) or cause.errno not in _REASONS:
            raise
        raise storage_error(path, cause) from cause
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def temporary_path(target: Path) -> Path:
    """Return a free name beside `target`, which `remove_parts` knows."""
    return target.with_name(f".{target.name[:_KEPT]}.{secrets.token_hex(4)}.part")


def create_folder(folder: Path) -> None:
    """Create the folder of a command's output and those above it. Raises StorageError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as cause:
        raise StorageError(f"{folder}: expected a folder, found a file; choose another folder") from cause
    except OSError as cause:
        reason = _REASONS.get(cause.errno or 0) or f"{cause.strerror}; choose another folder"
        raise StorageError(f"{folder}: cannot be written: {reason}") from cause


def remove_parts(folder: Path, name: str = "*") -> None:
    """Remove the temporary files that killed processes left in a folder while writing `name`, or any file."""
    for part in folder.glob(f".{name if name == '*' else glob.escape(name[:_KEPT])}.????????.part"):
        with contextlib.suppress(OSError):
            part.unlink()


def sha256(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _flush(part: Path) -> None:
    with open(part, "rb+") as file:
        os.fsync(file.fileno())


def existing(path: str | os.PathLike[str]) -> Path:
    """Return `path` if it is a readable file.

    Raises:
        StorageError: it is missing, a folder, or unreadable.
    """
    try:
        with open(path, "rb"):
            return Path(path)
    except FileNotFoundError as cause:
        name = os.fsdecode(path)
        # In TOML, \t in a name written with backslashes is a tab.
        windows = os.sep == "/" and ("\\" in name or any(letter < " " for letter in name))
        advice = "write / in place of \\ between folders" if windows else "check the name and the folder"
        raise StorageError(f"{_printable(name)}: there is no such file; {advice}") from cause
    except IsADirectoryError as cause:
        raise StorageError(f"{path}: is a folder; give the name of a file") from cause
    except OSError as cause:
        raise StorageError(f"{path}: cannot be read: {cause.strerror}; check its permissions and its disk") from cause
    except ValueError as cause:  # a null character, or one that the file system has no code for
        raise StorageError(f"{os.fspath(path)!r} is no name of a file: {cause}; correct the name") from cause


def _printable(name: str) -> str:
    """Return a name with its control characters as TOML and Python write them."""
    return "".join(letter if letter >= " " else repr(letter)[1:-1] for letter in name)
