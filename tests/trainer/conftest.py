"""Coarse grids of interiors, for tests that do not depend on their fineness."""

import pytest

from prt_bake.trainer import interior, material


@pytest.fixture
def coarse_interior(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids of at most 48³ points, which take an eighth of the time of 96³, and fewer samples of textures."""
    monkeypatch.setattr(interior, "_MOST_POINTS", 48**3)
    monkeypatch.setattr(material, "_SURFACE_SAMPLES", 20_000)
