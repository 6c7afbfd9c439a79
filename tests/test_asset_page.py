"""The reader in docs/asset.md agrees with `shade`."""

import re
from pathlib import Path
from typing import Any

import numpy as np

import prt_bake as prt
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci
from tests import ROOT
from tests.baking.lobes.transports import MESH, Lobed

CODE = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "asset.md").read_text(encoding="utf-8"), re.DOTALL)[0]


def test_the_reader_of_the_page_gives_the_radiance_of_shade(tmp_path: Path) -> None:
    asset = prt.bake(Lobed(), MESH, rings=8, sectors=16, lobes=4, out=tmp_path / "lobed.h5")
    assert asset.lobes is not None
    v, u = (np.indices((64, 128)) + 0.5) / np.array([64, 128])[:, None, None]
    image = 0.3 + np.exp(3.0 * np.cos(2.0 * np.pi * (u - 0.3)) * np.sin(np.pi * v))[..., None] * [1.0, 2.0, 0.5]
    sky = Lighting((Sky(image.astype(np.float32), "y", np.eye(3)),))
    eye, directions = np.array([2.0, 1.5, -3.0]), fibonacci(20_000)
    page: dict[str, Any] = {}
    exec(CODE, page)
    expected = prt.shade(asset, prt.light_for(asset, sky), eye)
    seen = np.flatnonzero((MESH.normals * (eye - MESH.positions)).sum(axis=1) > 0.1)[::3]
    for vertex in seen.tolist():
        found = page["radiance"](tmp_path / "lobed.h5", vertex, eye, sky.radiance, directions)
        np.testing.assert_allclose(found, expected[vertex], atol=0.01 * expected.max())


def test_the_harmonics_of_the_page_are_those_of_the_basis() -> None:
    page: dict[str, Any] = {}
    exec(CODE, page)
    directions = fibonacci(50)
    np.testing.assert_allclose(page["basis"](directions), sh.evaluate(directions, 2), atol=1e-12)
