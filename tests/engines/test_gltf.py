"""The glTF file of spot in other people's programs: the validator, three.js, glTF-Transform and trimesh.

The Python of docs/reference/gltf.md reads what they write, and its table says what that is.
"""

import base64
import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import prt_bake as prt
from prt_bake.export.engine_form import engine_form
from prt_bake.export.quantization import quantized
from tests import ROOT
from tests.engines.conftest import RunNode
from tests.export.test_onto import export, textured

PAGE = (ROOT / "docs/reference/gltf.md").read_text(encoding="utf-8")
READER: dict[str, Any] = {}
exec("".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[:3]).replace('print(check("spot.glb"))', ""), READER)
TABLE = dict(re.findall(r"^\| `([^`]+)` \|[^|]*\| ([^|]*) \|$", PAGE.split("## Which programs")[1], re.MULTILINE))
SKY = np.linspace(3.0, 0.1, 27).reshape(9, 3)
FORMS: dict[str, dict[str, Any]] = {"float": {}, "int8": {"quantize": "int8"}, "light": {"light": SKY}}


@pytest.fixture(scope="module")
def files(spot: Path) -> Path:
    """A folder with a file of each form, and onto.glb, which is the user's file user.glb with the attributes."""
    with prt.read_asset(spot / "spot.h5") as asset:
        for name, options in FORMS.items():
            prt.export_gltf(asset, spot / f"{name}.glb", **options)
        scene = trimesh.Scene(prt.read_mesh(spot / "spot.obj").to_trimesh())
        scene.export(spot / "user.glb")
        prt.export_gltf(asset, spot / "onto.glb", onto=spot / "user.glb")
    return spot


@pytest.fixture(scope="module")
def transformed(files: Path, run_node: RunNode) -> tuple[Path, dict[str, int]]:
    """A folder with what the functions of the table make of float.glb, and the sizes of the files."""
    folder = files / "transformed"
    folder.mkdir()
    return folder, run_node("gltf.mjs", "transform", files / "float.glb", folder, *TABLE)


def extras(path: Path) -> Any:
    content = path.read_bytes()
    return json.loads(content[20 : 20 + struct.unpack_from("<I", content, 12)[0]])["meshes"][0]["extras"]["prtbake"]


def test_the_validator_finds_nothing(files: Path, run_node: RunNode) -> None:
    paths = [files / f"{name}.glb" for name in (*FORMS, "onto")]
    for path, found in run_node("gltf.mjs", "validate", *paths).items():
        assert (found["errors"], found["warnings"]) == (0, 0), f"{path}: {found['messages']}"


@pytest.mark.parametrize("name", FORMS)
def test_three_finds_the_same_bits(files: Path, run_node: RunNode, name: str) -> None:
    (mesh,) = run_node("gltf.mjs", "three", files / f"{name}.glb")
    with prt.read_asset(files / "spot.h5") as asset:
        form = engine_form(asset, 3, SKY if name == "light" else None)
        mesh_of_asset = asset.mesh
    stored = quantized(form).codes if name == "int8" else form.coefficients

    def read(attribute: str, kind: str = "f4") -> np.ndarray:
        found = mesh["attributes"][attribute]
        return np.frombuffer(base64.b64decode(found["bytes"]), kind).reshape(-1, found["itemSize"])

    for r in range(16):
        for k in range(stored.shape[2]):
            attribute = f"_prt_{r}" if name == "light" else f"_prt_{r}_{k}"
            found = _of_three(mesh["attributes"][attribute], stored.dtype)
            assert np.array_equal(found, stored[:, r, k]), attribute
    assert mesh["extras"] == extras(files / f"{name}.glb")
    matrix = np.reshape(mesh["matrix"], (4, 4)).T
    place = read("position") @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.allclose(place, 0.1 * mesh_of_asset.positions, atol=1e-7)  # decimetres in the asset, metres in glTF


def _of_three(attribute: Any, kind: Any) -> np.ndarray:
    """The numbers of an attribute [V,3]; bytes are padded to 4."""
    values = np.frombuffer(base64.b64decode(attribute["bytes"]), kind)
    return values.reshape(-1, 4 if np.dtype(kind).itemsize == 1 else 3)[:, :3]


@pytest.mark.parametrize("name", TABLE)
def test_the_table_says_what_is_kept(files: Path, transformed: tuple[Path, Any], name: str) -> None:
    path = transformed[0] / f"{name}.plain.glb"
    found, _, error = READER["check"](path).partition(" by ")
    expected, _, stated = TABLE[name].partition(" by ")
    assert found == expected
    if stated:  # rounding of coefficients, which the shipped network decides
        assert float(error) == pytest.approx(float(stated), rel=0.5)
    before, after, number = READER["read"](files / "float.glb")[1], *READER["read"](path)[1:]
    if name != "quantize":  # who keeps a vertex keeps its numbers
        assert np.array_equal(after, before if number is None else before[number])


def test_the_validator_on_what_was_transformed(transformed: tuple[Path, Any], run_node: RunNode) -> None:
    reports = run_node("gltf.mjs", "validate", *(transformed[0] / f"{name}.glb" for name in TABLE))
    refused = {Path(path).stem for path, found in reports.items() if found["errors"] or found["warnings"]}
    assert refused == {"read, write interleaved"}


def test_three_reads_meshopt(files: Path, transformed: tuple[Path, Any], run_node: RunNode) -> None:
    (mesh,) = run_node("gltf.mjs", "three", transformed[0] / "EXT_meshopt_compression.glb")
    before = READER["read"](files / "float.glb")[1]
    for r in range(16):
        assert np.array_equal(_of_three(mesh["attributes"][f"_prt_{r}_4"], np.float32), before[:, r, 4])


@pytest.mark.parametrize("name", [*FORMS, "onto"])
def test_trimesh_keeps_attributes_and_extras(files: Path, tmp_path: Path, name: str) -> None:
    scene = trimesh.load_scene(files / f"{name}.glb", process=False)
    (mesh,) = scene.geometry.values()
    read = READER["read"](files / f"{name}.glb")[1]
    attribute, size = ("_PRT_7", 1.0) if name == "light" else ("_PRT_7_5", 1.0)
    if name == "int8":
        size = np.array(extras(files / "int8.glb")["scales"])[7, 5] / 127.0
    column = read[:, 7, 0 if name == "light" else 5]
    assert np.allclose(mesh.vertex_attributes[attribute] * size, column, rtol=1e-6)
    assert mesh.metadata["prtbake"]["version"] == "1.0"


def test_the_user_file_has_the_same_coefficients(files: Path) -> None:
    plain, onto = (READER["read"](files / f"{name}.glb") for name in ("float", "onto"))
    assert np.array_equal(onto[1], plain[1][onto[2]])
    assert len(onto[2]) >= onto[0]["vertices"]
    assert READER["check"](files / "onto.glb").startswith("self-test passed")


@pytest.mark.parametrize("quantize", [None, "int8"])
def test_a_file_with_materials_pictures_and_animations_stays_valid(
    tmp_path: Path, run_node: RunNode, quantize: str | None
) -> None:
    before = textured().write(tmp_path / "before.glb")
    found = export(before, quantize=quantize)
    assert READER["check"](tmp_path / "exported.glb") == "self-test passed, vertices reordered"
    assert len(found.json["meshes"][0]["primitives"]) == 2
    for report in run_node("gltf.mjs", "validate", before, tmp_path / "exported.glb").values():
        assert (report["errors"], report["warnings"]) == (0, 0), report["messages"]
    for number, mesh in enumerate(run_node("gltf.mjs", "three", tmp_path / "exported.glb")):
        values = _of_three(mesh["attributes"]["_prt_3_8"], np.int8 if quantize else np.float32)
        assert np.array_equal(values / (127.0 if quantize else 1.0), found.read(0, number, "_PRT_3_8"))


def test_sizes(files: Path, run_node: RunNode, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = {name: (files / f"{name}.glb").stat().st_size for name in FORMS}
    compressed = run_node("gltf.mjs", "transform", files / "int8.glb", tmp_path, "EXT_meshopt_compression")
    sizes["int8 with EXT_meshopt_compression"] = compressed["EXT_meshopt_compression"]
    with capsys.disabled():
        print("\nspot as glTF:", ", ".join(f"{name} {size / 1e6:.2f} MB" for name, size in sizes.items()))
    assert sizes["float"] <= 5_500_000
    assert sizes["int8"] <= 2_000_000
    assert sizes["int8 with EXT_meshopt_compression"] <= 1_300_000
    assert READER["check"](tmp_path / "EXT_meshopt_compression.plain.glb") == "self-test passed"
