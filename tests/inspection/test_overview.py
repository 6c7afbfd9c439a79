"""The first screen of `prtbake info`: the object, its size, its error, and what a picture can be."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

from formats.asset import write_asset
from formats.asset.total_error import ErrorInterval
from formats.errors import FormatError
from formats.image import write_image
from formats.mesh import build_mesh, write_mesh
from formats.scene import read_scene
from prt_bake import bake, export_gltf
from prt_bake.inspection import describe, find_faults, find_remarks, overview
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF, save_model
from prt_bake.trainer.fit import metadata_of
from tests.network.functions.test_onnx import FLOAT
from tests.network.functions.test_onnx import write as onnx_file
from tests.shading.test_picture import make_asset
from tests.shapes import ball


def test_a_length_is_in_millimetres_where_the_unit_is_known(tmp_path: Path) -> None:
    asset = dataclasses.replace(make_asset(ball(1)), unit="dm", network_error=ErrorInterval(0.06, 0.05, 0.08))
    write_asset(asset, tmp_path / "a.h5")
    lines = overview(describe(tmp_path / "a.h5"))
    assert lines["longest side"] == "2 dm (200 mm)"
    assert lines["error of the coefficients"] == str(asset.error)
    assert lines["complete"] == "yes"
    assert "provenance" not in str(lines)
    write_asset(dataclasses.replace(asset, unit="unit", complete=False), tmp_path / "b.h5")
    lines = overview(describe(tmp_path / "b.h5"))
    assert lines["longest side"] == "2 scene units"
    assert lines["complete"] == "no; `prtbake bake --resume` goes on where the bake stopped"


def test_an_onnx_function_is_sound_and_named(tmp_path: Path) -> None:
    path = onnx_file(tmp_path / "a.onnx", [("x", FLOAT, ["n", 7])], [("y", FLOAT, ["n", 3])])
    assert find_faults(path) == []
    (remark,) = find_remarks(path)
    assert remark.startswith("an ONNX function, from x [n, 7] of float32 to y [rows, 3]; `prtbake bake --convention`")
    lines = overview(describe(path))
    assert lines["kind"] == "function: a network of another program, for `prtbake bake --convention`"
    assert (lines["input"], lines["output"]) == ("x [n, 7] of float32", "y [rows, 3]")
    (fault,) = find_faults(onnx_file(path, [("x", FLOAT, ["n", 9])], [("y", FLOAT, ["n", 3])]))
    assert "expected one input [rows, 7], found x [n, 9]" in fault


def test_an_exported_asset_states_its_errors(tmp_path: Path) -> None:
    asset = dataclasses.replace(make_asset(ball(1)), network_error=ErrorInterval(0.06, 0.05, 0.08))
    error = export_gltf(asset, tmp_path / "a.glb")
    lines = overview(describe(tmp_path / "a.glb"))
    assert lines["kind"] == "exported asset: a mesh with baked light for engines and browsers, under any light"
    assert lines["error of the asset"] == str(asset.error)
    assert lines["error of the export"] == f"{error.coefficients:.1%} of the coefficients of the asset"
    assert lines["harmonics"] == "degree 3 of the view, 2 of the light"
    trimesh.creation.box().export(tmp_path / "b.glb")
    assert overview(describe(tmp_path / "b.glb"))["kind"] == "mesh"


def test_other_programs_may_remove_what_an_exported_asset_states(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "a.glb")
    figures = describe(tmp_path / "a.glb") | {"exported": {"quantity": "radiance", "error": None, "left_out": None}}
    lines = overview(figures)
    assert lines["kind"].endswith("under one light, which cannot change")
    assert "error of the export" not in lines
    assert "error of the asset" not in lines


@pytest.mark.parametrize(
    ("model", "kind"),
    [
        ("neural bssrdf", "model: a network that was trained on one object"),
        ("neumip", "model: NeuMIP, a baseline, trained on one object"),
        ("nerfactor", "model: NeRFactor, a baseline, trained on one object"),
    ],
)
def test_a_model_is_named_by_its_kind(model: str, kind: str) -> None:
    assert overview({"kind": "model", "model": model, "bytes": 9, "box side": 1.0, "weights": 2})["kind"] == kind


def test_an_asset_of_one_light_says_so(tmp_path: Path) -> None:
    asset = make_asset(ball(1), degree=0)
    write_asset(dataclasses.replace(asset, quantity="radiance", folded_in="x"), tmp_path / "a.h5")
    assert overview(describe(tmp_path / "a.h5"))["kind"] == "asset: a baked object under one light, which cannot change"


def test_an_asset_of_one_eye_says_so(tmp_path: Path) -> None:
    asset = make_asset(ball(1), provenance={"settings": {"for_eye": [0.0, 1.0, 9.0]}})
    write_asset(asset, tmp_path / "a.h5")
    assert overview(describe(tmp_path / "a.h5"))["view bins"] == "none, one eye at [0.0, 1.0, 9.0]"


def test_a_mesh_is_closed_or_has_open_edges(tmp_path: Path) -> None:
    mesh = ball(1)
    write_mesh(mesh, tmp_path / "a.ply")
    write_mesh(build_mesh(mesh.positions, mesh.faces[:-1]), tmp_path / "b.ply")
    closed, opened = (overview(describe(tmp_path / name)) for name in ("a.ply", "b.ply"))
    assert closed["closed"].startswith("yes, volume ")
    assert closed["size"] == "2 × 2 × 2 in a unit that the format does not name"
    assert opened["closed"] == "no, 3 open edges"


OTHERS = "a texture of a scene, a picture to compare"


@pytest.mark.parametrize(
    ("height", "width", "uses"),
    [
        (8, 16, f"a sky (--light), {OTHERS}"),
        (8, 9, f"{OTHERS}; a sky is twice as wide as high"),
        (8, 48, f"{OTHERS}; as a light this cube map must be converted to a lat-long picture"),
    ],
)
def test_a_picture_is_a_sky_only_if_it_can_be_one(tmp_path: Path, height: int, width: int, uses: str) -> None:
    write_image(tmp_path / "a.hdr", np.ones((height, width, 3), np.float32))
    lines = overview(describe(tmp_path / "a.hdr"))
    assert (lines["kind"], lines["can be"], lines["size"]) == ("picture", uses, f"{width} × {height} pixels")


def test_lights_files_are_described_and_checked(tmp_path: Path) -> None:
    write_image(tmp_path / "sky.hdr", np.ones((8, 16, 3), np.float32))
    path = tmp_path / "lights.toml"
    sphere = "[[sphere]]\nposition = [0, 9, 0]\nradius = 1\nradiance = [1, 1, 1]\n"
    path.write_text(f'[[sky]]\nfile = "sky.hdr"\n[[directional]]\ndirection = [0, 1, 0]\n{2 * sphere}')
    lines = overview(describe(path))
    assert lines["sphere lights"] == "2"
    assert (lines["kind"], lines["directional lights"]) == ("lights file, for --light", "1")
    assert lines["skies"] == str(tmp_path / "sky.hdr")
    assert not find_faults(path)
    path.write_text('[[sky]]\nfile = "none.hdr"\n')
    assert "none.hdr" in find_faults(path)[0]


def test_a_model_and_its_asset_name_their_material(tmp_path: Path) -> None:
    """Variants of one object differ in nothing else that `info` could print."""
    mesh = ball(1)
    write_mesh(mesh, tmp_path / "a.ply")
    text = '[object]\nmesh = "a.ply"\nunit = "cm"\n[medium]\n'
    (tmp_path / "own.toml").write_text(text + "sigma_t = 1.0\nalbedo = 0.9\n")
    assert "material" not in metadata_of(read_scene(tmp_path / "own.toml"))
    mix = '[medium.mix]\nmaterial = "marble vein"\npattern = "veins"\nfeature = 1.0\n'
    (tmp_path / "a.toml").write_text(text + 'material = "jade"\ndensity = 0.5\n' + mix)
    metadata = metadata_of(read_scene(tmp_path / "a.toml"))
    network = NeuralBSSRDF(NetworkSettings(features=8, width=16), (-1, -1, -1), 2.0, metadata=metadata)
    save_model(network, tmp_path / "a.pt")
    bake(network, mesh, rings=1, sectors=2, samples=18, lobes=0, out=tmp_path / "a.h5")
    for name in ("a.pt", "a.h5"):
        lines = overview(describe(tmp_path / name))
        assert lines["material"] == "jade, density 0.5, mixed with marble vein"


def test_a_checkpoint_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.train.pt").write_bytes(b"")
    with pytest.raises(FormatError, match=r"a\.train\.pt: is the checkpoint of a training, for `prtbake train --res"):
        describe(tmp_path / "a.train.pt")


def test_a_scene_names_what_is_inside_it(tmp_path: Path) -> None:
    for name, size in (("a.ply", 1.0), ("b.ply", 0.5), ("c.ply", 0.2)):
        mesh = ball(1)
        write_mesh(build_mesh(size * mesh.positions, mesh.faces), tmp_path / name)
    (tmp_path / "a.toml").write_text(
        '[object]\nmesh = "a.ply"\nunit = "cm"\n[medium]\nmaterial = "jade"\n'
        '[[inside]]\nname = "milk"\nmesh = "b.ply"\n[inside.medium]\nmaterial = "whole milk"\n'
        '[[inside]]\nname = "seed"\nmesh = "c.ply"\nin = "milk"\nsurface = "diffuse"\nreflectance = 0.5\n'
    )
    lines = overview(describe(tmp_path / "a.toml"))
    assert lines["inside"] == "milk, whole milk, measured with eta 1.3; the scene uses eta 1; seed, opaque"
    assert lines["longest side"] == "20 mm"
    assert lines["thickness"].endswith(" transport mean free paths; 5 to 50 look translucent")
