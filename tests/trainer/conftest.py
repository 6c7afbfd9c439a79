"""Coarse grids of interiors, for tests that do not depend on their fineness."""

import pytest

from prt_bake.trainer import interior


@pytest.fixture
def coarse_interior(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids of at most 48³ points, which take an eighth of the time of 96³."""
    monkeypatch.setattr(interior, "_MOST_POINTS", 48**3)
