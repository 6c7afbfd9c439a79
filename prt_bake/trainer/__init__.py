"""The reference path tracer, and the trainer that learns from it."""

from contextlib import suppress
from pathlib import Path


def _drop_stale_kernels(folder: Path) -> None:
    """Delete compiled kernels that are older than any source beside them.

    numba keeps a kernel by the file that it stands in, and does not see that what it calls has changed in another.
    """
    kernels = list((folder / "__pycache__").glob("*.nb[ci]"))
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    if kernels and min(kernel.stat().st_mtime for kernel in kernels) < newest:
        for kernel in kernels:
            with suppress(OSError):
                kernel.unlink()


_drop_stale_kernels(Path(__file__).parent)
