"""The Mitsuba integrator of the page on networks of your own, compared with the path tracer."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import prt_bake as prt
from tests import ROOT
from tests.documents.commands import blocks
from tests.mathematics.significance import assert_agree

PAGE = ROOT / "docs/how_to/own_transport.md"


@pytest.mark.statistics
def test_coefficients_of_mitsuba_agree_with_those_of_the_path_tracer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code = [block for block in blocks(PAGE.read_text(encoding="utf-8")) if block.language == "python"]
    needed = [block for block in code if "mitsuba" in block.code.lower()]
    mesh = prt.Mesh.from_trimesh(trimesh.creation.icosphere(subdivisions=2))
    names: dict[str, Any] = {"np": np, "prt": prt, "trimesh": trimesh, "mesh": mesh}
    for block in needed:
        exec(compile("\n" * block.line + block.code, str(PAGE), "exec"), names)
    theirs, ours = names["theirs"], names["ours"]
    assert theirs.mean.shape == (6, 9, 3)
    assert_agree(theirs.mean - names["through"], theirs.standard_error, ours.mean, ours.standard_error)
    assert np.all(theirs.standard_error[:, 0] < 0.05 * ours.mean[:, 0])
