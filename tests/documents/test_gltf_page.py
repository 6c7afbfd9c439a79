"""The reader in docs/reference/gltf.md reproduces the self-test and, within the stated error, `shade`."""

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci
from tests import ROOT
from tests.export.assets import smooth_asset

PAGE = (ROOT / "docs" / "reference" / "gltf.md").read_text(encoding="utf-8")
READER, HARMONICS, CHECK, UNDER_A_SKY = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
FORMS: dict[str, dict[str, Any]] = {
    "float": {},
    "int8": {"quantize": "int8"},
    "degree 6": {"degree": 6},
    "one light": {"light": np.ones((9, 3))},
}


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names that the page defines, in a folder with spot.h5, spot.glb and sky.hdr."""
    monkeypatch.chdir(tmp_path)
    asset = smooth_asset()
    prt.write_asset(asset, "spot.h5")
    prt.export_gltf(asset, "spot.glb")
    prt.write_image("sky.hdr", np.linspace(0, 1, 8 * 16 * 3).reshape(8, 16, 3))
    names: dict[str, Any] = {}
    exec(READER + HARMONICS + CHECK, names)
    return names


def test_the_reader_is_short() -> None:
    assert len(READER.splitlines()) <= 40


@pytest.mark.parametrize("form", FORMS)
def test_the_reader_passes_the_self_test(page: dict[str, Any], form: str) -> None:
    prt.export_gltf(smooth_asset(), "form.glb", **FORMS[form])
    assert page["check"]("form.glb") == "self-test passed"


def test_the_reader_takes_a_file_without_the_keys_that_are_null(page: dict[str, Any]) -> None:
    """pygltflib removes them."""
    content = Path("spot.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    extras = document["meshes"][0]["extras"]
    kept = {name: value for name, value in extras["prtbake"].items() if value is not None}
    assert len(kept) < len(extras["prtbake"])
    extras["prtbake"] = kept
    text = json.dumps(document, separators=(",", ":")).encode().ljust(length)
    Path("resaved.glb").write_bytes(content[:20] + text + content[20 + length :])
    assert page["check"]("resaved.glb") == "self-test passed"


def test_the_page_compares_a_frame_with_shade(page: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    exec(UNDER_A_SKY, page)
    assert capsys.readouterr().out.endswith("True\n")
    assert 0.001 < page["error"] < 0.1


def test_the_harmonics_of_the_page_are_ours(page: dict[str, Any]) -> None:
    directions = fibonacci(50)
    np.testing.assert_allclose(page["harmonics"](directions, 8), sh.evaluate(directions, 8), atol=1e-12)


def test_the_page_names_every_key_and_attribute(page: dict[str, Any]) -> None:
    prt.export_gltf(smooth_asset(), "int8.glb", quantize="int8")
    extras = page["read"]("int8.glb")[0]
    names = {*extras, *extras["light"], *extras["error"], *extras["selftest"], *extras["texels"]}
    names |= {"POSITION", "NORMAL", "TEXCOORD_0", "TEXCOORD_1", "COLOR_0", "texel_attribute"}
    assert [name for name in sorted(names) if f"`{name}`" not in PAGE] == []


def rearranged(source: str, target: str, order: np.ndarray) -> None:
    """Write a file whose vertices are the vertices `order` of another one; faces are not changed."""
    content = bytearray(Path(source).read_bytes())
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    for accessor in document["meshes"][0]["primitives"][0]["attributes"].values():
        view = document["bufferViews"][document["accessors"][accessor]["bufferView"]]
        rows = np.frombuffer(content, np.uint8, view["byteLength"], 28 + length + view["byteOffset"])
        rows = rows.reshape(len(order), -1)
        rows[:] = rows[order]
    Path(target).write_bytes(content)


def test_the_page_finds_what_other_programs_have_changed(page: dict[str, Any]) -> None:
    count = len(smooth_asset().valid)
    rearranged("spot.glb", "reordered.glb", np.random.default_rng(0).permutation(count))
    assert page["check"]("reordered.glb") == "self-test passed, vertices reordered"
    rearranged("spot.glb", "merged.glb", np.where(np.arange(count) == 5, 4, np.arange(count)))
    assert page["check"]("merged.glb") == f"1 of {count} vertices were merged or removed"
    content = bytearray(Path("spot.glb").read_bytes())
    content[-100_000:-50_000] = content[-100_000 + 12 : -50_000 + 12]  # coefficients of a neighbour
    Path("damaged.glb").write_bytes(content)
    assert page["check"]("damaged.glb").startswith("self-test off by")
