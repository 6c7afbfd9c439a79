"""Says when kernels are compiled, and records how long that takes.

Free of numba, so that the command line can ask for it before anything is loaded.
"""

from collections.abc import Callable

say: Callable[[str], None] | None = None
"""Called with a sentence before this process compiles its first kernel; None: nothing is said."""
said = False
compiled: list[tuple[str, float]] = []
"""Name and seconds of each kernel that this process compiled. Kernels that it calls are counted with it."""


def announce(folder: str | None, kept: bool) -> None:
    """Say once that kernels are compiled.

    Args:
        folder: where kernels can be kept; None if no folder can be written.
        kept: whether this kernel is kept there; it is not if a source was edited after this process began.
    """
    global said
    if said or say is None:
        return
    said = True
    if folder is None:
        say(
            "compiling kernels; this takes about a minute in every run, since neither the package's folder nor the "
            "user's cache folder can be written; to keep them, set NUMBA_CACHE_DIR to a folder that can"
        )
    elif kept:
        say(f"compiling kernels, once; this takes about a minute, and they are kept in {folder}")
    else:
        say("compiling kernels; they are not kept, since a source was edited after this process began")


def seconds() -> float:
    """Return the time that was spent on compilation, in seconds."""
    return sum(taken for _, taken in compiled)
