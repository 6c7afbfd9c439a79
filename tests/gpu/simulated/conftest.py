"""Lets numba simulate a GPU in Python, if there is none; numba reads the variable once, when it is imported."""

import os
from pathlib import Path

import pytest

if not Path("/dev/nvidiactl").exists():
    os.environ["NUMBA_ENABLE_CUDASIM"] = "1"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Random numbers of 64 bits may overflow in Python, as they do in machine code."""
    for item in items:
        item.add_marker(pytest.mark.filterwarnings("ignore:overflow encountered in scalar:RuntimeWarning"))


@pytest.fixture(autouse=True)
def few_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few simulated threads."""
    from prt_bake.tracer.gpu import device_functions, exits

    if device_functions.SIMULATED:
        monkeypatch.setattr(exits, "THREADS", 4)
