"""The signals that a command has received: Ctrl-C (SIGINT) and SIGTERM decide its exit code.

A command that is stopped keeps what it has computed and may end with an error or without one. Its exit code is that of
shells in both cases: 128 plus the number of the signal.
"""

import signal

STOPPING = (signal.SIGINT, signal.SIGTERM)
_received: list[int] = []


def forget() -> None:
    """Forget earlier signals, when a command begins."""
    _received.clear()


def record(number: int) -> None:
    """Record a signal, when its handler runs."""
    _received.append(number)


def exit_code(code: int) -> int:
    """Return `code`, or 128 plus the first signal if any was received: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + _received[0] if _received else code


def sentence() -> str:
    """Return what a command says that was stopped before it was finished."""
    name = "SIGTERM" if _received[:1] == [signal.SIGTERM] else "Ctrl-C"
    return f"stopped by {name} before it was finished"
