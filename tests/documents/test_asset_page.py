"""The readers in docs/reference/asset.md reproduce the self-test and the radiance of `shade`."""

import re
import subprocess
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import prt_bake as prt
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci
from tests import ROOT
from tests.baking.lobes.transports import MESH, Lobed
from tests.baking.prunable_scenes import Grey

PAGE = (ROOT / "docs" / "reference" / "asset.md").read_text(encoding="utf-8")
READER, SELF_TEST, UNDER_A_SKY, WITH_LOBES, _ERROR = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
PROGRAM = re.findall(r"```c\n(.*?)```", PAGE, re.DOTALL)[0]
EYE = np.array([2.0, 1.5, -3.0])
LIGHT = np.random.default_rng(1).normal(size=(9, 3)) + [[3.0, 2.0, 1.0]] * 9


PRUNED = {"rings": 8, "sectors": 32, "samples": 64}
ASSETS: dict[str, tuple[Any, dict[str, Any]]] = {
    "plain": (Lobed(), {}),
    "one channel": (Grey(), PRUNED | {"leave_out": ("channels",)}),
    "one view": (Grey(), PRUNED | {"leave_out": ("views",)}),
    "one view and one channel": (Grey(), PRUNED | {"leave_out": ("views", "channels")}),
    "one light": (Lobed(), {"for_light": LIGHT}),
    "one eye": (Lobed(), {"for_eye": EYE}),
    "one light and one eye": (Lobed(), {"for_light": LIGHT, "for_eye": EYE}),
    "one ring": (Lobed(), {"rings": 1, "sectors": 4}),
}
SHAPES = {
    "plain": (32, 9, 3),
    "one channel": (256, 9, 1),
    "one view": (1, 9, 3),
    "one view and one channel": (1, 9, 1),
    "one light": (32, 1, 3),
    "one eye": (1, 9, 3),
    "one light and one eye": (1, 1, 3),
    "one ring": (4, 9, 3),
}


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """The names that the two readers of the page define."""
    names: dict[str, Any] = {}
    exec(READER + WITH_LOBES, names)
    return names


def test_the_first_reader_has_thirty_lines() -> None:
    assert len(READER.splitlines()) <= 32


@pytest.mark.parametrize("name", ASSETS)
def test_the_reader_gives_the_self_test_and_the_radiance_of_shade(
    page: dict[str, Any], tmp_path: Path, name: str
) -> None:
    transport, options = ASSETS[name]
    asset = prt.bake(transport, MESH, out=tmp_path / "a.h5", **{"rings": 4, "sectors": 8, "samples": 32} | options)
    assert asset.coefficients.shape[1:] == SHAPES[name]
    vertices = np.flatnonzero(asset.valid)
    outgoing = EYE - MESH.positions
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    with h5py.File(tmp_path / "a.h5") as file:
        test = {name: values[...] for name, values in file["selftest"].items()}
        found = page["radiance"](file, test["light"], test["vertex"], test["outgoing"])
        np.testing.assert_allclose(found, test["radiance"], atol=1e-3 * np.abs(test["radiance"]).max())
        found = page["radiance"](file, LIGHT, vertices, outgoing[vertices])
    expected = prt.shade(asset, None if "for_light" in options else LIGHT, EYE)[vertices]
    np.testing.assert_allclose(np.maximum(found, 0), expected, atol=1e-5 * expected.max())


def test_the_page_runs_its_self_test_and_its_sky(
    page: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    asset = prt.bake(Lobed(), MESH, rings=4, sectors=8, samples=32, out="spot.h5")
    prt.write_image("sky.hdr", np.linspace(0, 1, 8 * 16 * 3).reshape(8, 16, 3))
    exec(SELF_TEST + UNDER_A_SKY, page)
    assert capsys.readouterr().out == "True\n"
    expected = prt.shade(asset, prt.project_environment(prt.read_environment("sky.hdr")), [0.0, 1.0, 4.0])
    np.testing.assert_allclose(page["colours"], expected, atol=1e-5 * expected.max())


AROUND_THE_PROGRAM = """
#include <algorithm>
#include <cmath>
#include <cstdio>
using std::atan2, std::floor;
struct float3 {{
    float r, g, b;
    float3(float v = 0) : r(v), g(v), b(v) {{}}
    float3(float x, float y, float z) : r(x), g(y), b(z) {{}}
}};
float3 operator+(float3 a, float3 b) {{ return {{a.r + b.r, a.g + b.g, a.b + b.b}}; }}
float3 operator*(float s, float3 a) {{ return {{s * a.r, s * a.g, s * a.b}}; }}
float3 operator/(float3 a, float s) {{ return {{a.r / s, a.g / s, a.b / s}}; }}
void operator+=(float3 &a, float3 b) {{ a = a + b; }}
float dot(float3 a, float3 b) {{ return a.r * b.r + a.g * b.g + a.b * b.b; }}
float3 cross(float3 a, float3 b) {{ return {{a.g * b.b - a.b * b.g, a.b * b.r - a.r * b.b, a.r * b.g - a.g * b.r}}; }}
float clamp(float v, float low, float high) {{ return std::min(std::max(v, low), high); }}
int min(int a, int b) {{ return std::min(a, b); }}
float3 max(float3 a, int) {{ return a; }}  // the self-test is not clamped
const float PI = 3.14159265f;
const int rings = {rings}, sectors = {sectors};
struct Row {{ float bins[rings * sectors][3]; float3 normal, tangent, to_viewer; }} row;
float3 C(int b) {{ return {{row.bins[b][0], row.bins[b][1], row.bins[b][2]}}; }}
{program}
int main() {{
    while (std::fread(&row, sizeof row, 1, stdin)) {{
        float3 found = radiance(row.normal, row.tangent, row.to_viewer);
        std::printf("%.9g %.9g %.9g\\n", found.r, found.g, found.b);
    }}
}}
"""


def test_the_program_of_the_page_gives_the_self_test(tmp_path: Path) -> None:
    asset = prt.bake(Lobed(), MESH, rings=4, sectors=8, samples=32)
    test, vertex = asset.selftest, asset.selftest["vertex"]
    source = AROUND_THE_PROGRAM.format(rings=4, sectors=8, program=PROGRAM)
    by_bin = (asset.coefficients[vertex] * test["light"]).sum(axis=2).reshape(len(vertex), -1)
    rows = np.hstack([by_bin, MESH.normals[vertex], asset.tangents[vertex], test["outgoing"]]).astype(np.float32)
    (tmp_path / "program.cpp").write_text(source, encoding="utf-8")
    subprocess.run(["c++", "-std=c++17", "-o", tmp_path / "program", tmp_path / "program.cpp"], check=True)
    printed = subprocess.run([tmp_path / "program"], check=True, capture_output=True, input=rows.tobytes()).stdout
    found = np.array([line.split() for line in printed.splitlines()], np.float64)
    np.testing.assert_allclose(found, test["radiance"], atol=1e-5 * np.abs(test["radiance"]).max())


def test_the_reader_of_lobes_gives_the_radiance_of_shade(page: dict[str, Any], tmp_path: Path) -> None:
    asset = prt.bake(Lobed(), MESH, rings=8, sectors=16, lobes=4, out=tmp_path / "lobed.h5")
    assert asset.lobes is not None
    v, u = (np.indices((64, 128)) + 0.5) / np.array([64, 128])[:, None, None]
    image = 0.3 + np.exp(3.0 * np.cos(2.0 * np.pi * (u - 0.3)) * np.sin(np.pi * v))[..., None] * [1.0, 2.0, 0.5]
    sky = Lighting((Sky(image.astype(np.float32), "y", np.eye(3)),))
    directions = fibonacci(20_000)
    expected = prt.shade(asset, prt.light_for(asset, sky), EYE)
    seen = np.flatnonzero((MESH.normals * (EYE - MESH.positions)).sum(axis=1) > 0.1)[::3]
    with h5py.File(tmp_path / "lobed.h5") as file:
        for vertex in seen.tolist():
            outgoing = (EYE - MESH.positions[vertex]) / np.linalg.norm(EYE - MESH.positions[vertex])
            found = page["lobed_radiance"](file, vertex, outgoing, sky.radiance, directions)
            np.testing.assert_allclose(found, expected[vertex], atol=0.01 * expected.max())


def test_the_harmonics_of_the_page_are_those_of_the_basis(page: dict[str, Any]) -> None:
    directions = fibonacci(50)
    np.testing.assert_allclose(page["harmonics"](directions), sh.evaluate(directions, 2), atol=1e-12)


def test_the_page_names_every_dataset_and_attribute_of_a_file(tmp_path: Path) -> None:
    prt.bake(Lobed(), MESH, rings=8, sectors=16, lobes=4, out=tmp_path / "lobed.h5")
    names: set[str] = set()
    with h5py.File(tmp_path / "lobed.h5") as file:
        names |= set(file.attrs)
        file.visititems(lambda path, item: names.update([path.split("/")[-1], *item.attrs]))
    assert len(names) > 50
    assert [name for name in sorted(names) if not re.search(rf"[`/]{name}\b", PAGE)] == []
