"""The reference path tracer, and the trainer that learns from it."""

from contextlib import suppress
from pathlib import Path


def _drop_stale_kernels(folder: Path) -> None:
    """Delete compiled kernels that are older than any source beside them.

    numba keeps a kernel by the file that it stands in, and does not see that what it calls has changed in another.
    """
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for kernel in (folder / "__pycache__").glob("*.nb[ci]"):
        # Another process may be at the same work, or have no right to it.
        with suppress(OSError):
            if kernel.stat().st_mtime < newest:
                kernel.unlink()


_drop_stale_kernels(Path(__file__).parent)
