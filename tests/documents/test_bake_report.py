"""docs/reference/bake_report.md has every key of a report."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

import prt_bake as prt
from prt_bake.baking.report.summary import bake_report
from tests import ROOT
from tests.baking.lobes.transports import MESH, Lobed

PAGE = (ROOT / "docs" / "reference" / "bake_report.md").read_text(encoding="utf-8")
GRID = {"rings": 4, "sectors": 8}


def keys(table: Mapping[str, Any]) -> Iterator[str]:
    """All keys of nested tables, without those of the model, and without numbers of directions."""
    for key, value in table.items():
        if not key.isdigit():
            yield key
        if isinstance(value, Mapping) and key != "model":
            yield from keys(value)


def on_the_page(key: str) -> bool:
    """Whether a table or a heading of the page has the key."""
    return re.search(rf"`{key}`|^### {key}$", PAGE, re.MULTILINE) is not None


@pytest.mark.parametrize(
    "settings",
    [{"samples": 18}, {"error": 0.05, "lobes": 4}, {"samples": 32, "for_light": [[1.0] * 3] * 9}],
    ids=["fixed", "adaptive", "one light"],
)
@pytest.mark.parametrize("compact", [False, True])
def test_every_key_is_on_the_page(settings: dict[str, Any], compact: bool) -> None:
    asset = prt.bake(Lobed(), MESH, **GRID, **settings)
    report = bake_report(prt.compress(asset, 0.01) if compact else asset)
    assert len(set(keys(report))) > 30
    assert [key for key in sorted(set(keys(report))) if not on_the_page(key)] == []


def test_every_key_of_a_path_traced_bake_is_on_the_page() -> None:
    scene = prt.load_scene(prt.example("spot.toml"))
    mesh = prt.read_mesh(prt.example("spot.obj"))
    few = prt.Mesh(mesh.positions[mesh.faces[0]], [[0, 1, 2]], mesh.normals[mesh.faces[0]])
    report = bake_report(prt.bake(scene, few, rings=1, sectors=2, samples=4))
    assert {"walks", "unreliable_bins"} <= set(keys(report))
    assert [key for key in sorted(set(keys(report))) if not on_the_page(key)] == []
