"""The scenes and meshes that `prtbake make` takes, refuses or remarks on."""

from pathlib import Path

import pytest
import trimesh
import typer

from formats.errors import PrtbakeError
from formats.mesh import flipped, read_mesh, write_mesh


def test_another_scene_or_foreign_files_are_refused(stand_ins):
    stand_ins.run("wax.toml", "-o", "out")
    text = Path("wax.toml").read_text()
    Path("wax.toml").write_text(text.replace("density = 1.0", "density = 2.0"))
    with pytest.raises(
        PrtbakeError, match=r"out: wax\.toml has changed .*density was 1\.0, is 2\.0; .* --from out/mod"
    ):
        stand_ins.run("wax.toml", "-o", "out")
    Path("wax.toml").write_text(text.replace('up = "y"', 'up = "z"'))
    with pytest.raises(PrtbakeError, match=r"wax\.toml has changed since it was made: object\.up was y, is z; choose"):
        stand_ins.run("wax.toml", "-o", "out")
    Path("wax.toml").write_text(text)
    trimesh.load("ball.obj").subdivide().export("ball.obj")
    with pytest.raises(PrtbakeError, match=r"changed .*: a key, or a file that it names, such as"):
        stand_ins.run("wax.toml", "-o", "out")
    assert "object.up = y, " in Path("out/summary.md").read_text()
    stand_ins.seconds |= {"train": 150.0, "bake": 40.0}
    assert len(stand_ins.run("wax.toml", "-o", "out", "--minutes", "5", "--force")) == 4
    Path("out/summary.json").write_text("{}")
    with pytest.raises(PrtbakeError, match=r"summary\.json: was not written by `prtbake make`, or is damaged"):
        stand_ins.run("wax.toml", "-o", "out")
    Path("out/summary.json").unlink()
    with pytest.raises(PrtbakeError, match=r"model\.pt: already exists; choose another folder, or add --force"):
        stand_ins.run("wax.toml", "-o", "out")


def test_a_mesh_gets_a_scene_in_the_folder(stand_ins, capsys):
    stand_ins.run("ball.obj", "-o", "out", "--material", "jade", "--size", "4cm")
    assert 'material = "jade"' in Path("out/ball.toml").read_text()
    assert stand_ins.run("ball.obj", "-o", "out", "--material", "jade", "--size", "4cm") == []
    assert "out/ball.toml: is there already, and is used; --force writes it again" in capsys.readouterr().err
    assert stand_ins.run("ball.obj", "-o", "out") == []
    with pytest.raises(PrtbakeError, match=r"ball\.toml: is another scene than --material, --size and --up ask for"):
        stand_ins.run("ball.obj", "-o", "out", "--material", "jade", "--size", "5cm")


def test_a_mesh_of_cad_is_told_its_axis(stand_ins, capsys):
    trimesh.load("ball.obj").export("ball.stl")
    stand_ins.run("ball.stl", "-o", "lying", "--material", "jade", "--size", "4cm")
    remark = "ball.stl: the format names no axis; y is taken to point up; in files of Blender and CAD it is --up z"
    assert remark in capsys.readouterr().err
    calls = stand_ins.run("ball.stl", "-o", "out", "--material", "jade", "--size", "4cm", "--up", "z")
    assert "names no axis" not in capsys.readouterr().err
    assert 'up = "z"' in Path("out/ball.toml").read_text()
    assert calls[2][3] == "sun:0.6,0.6,0.6:2,1.9,1.7:3"
    with pytest.raises(PrtbakeError, match=r"ball\.toml: is another scene than --material, --size and --up ask for"):
        stand_ins.run("ball.stl", "-o", "out", "--up", "y", "--material", "jade", "--size", "4cm")
    with pytest.raises(typer.BadParameter, match="--material, --size and --up are for meshes"):
        stand_ins.run("wax.toml", "-o", "new", "--up", "z")


def test_what_would_fail_later_is_refused_at_once(stand_ins):
    with pytest.raises(typer.BadParameter, match="--material, --size and --up are for meshes"):
        stand_ins.run("wax.toml", "-o", "out", "--material", "jade")
    with pytest.raises(PrtbakeError, match=r"asset\.h5: expected a scene or a mesh \(SCENE\), found an asset"):
        stand_ins.run(stand_ins.asset, "-o", "out")
    with pytest.raises(PrtbakeError, match=r"missing\.hdr: there is no such file"):
        stand_ins.run("wax.toml", "-o", "out", "--light", "missing.hdr")
    write_mesh(flipped(read_mesh("ball.obj")), "ball.obj")
    with pytest.raises(PrtbakeError, match=r"ball\.obj: the faces are wound inside out; flip the normals"):
        stand_ins.run("wax.toml", "-o", "out")
    for size, words in (("", "--material, --size and --up are"), ("0.1", "training, bake and pictures take 2 minutes")):
        with pytest.raises(typer.BadParameter, match=words):
            stand_ins.run("wax.toml", "-o", "out", *(["--minutes", size] if size else ["--size", "3cm"]))
    assert stand_ins.calls == []


def test_a_mesh_is_checked_before_anything_is_written(stand_ins):
    trimesh.load("ball.obj").export("ball.glb")  # 2 m
    with pytest.raises(typer.BadParameter, match="Missing option '--material'"):
        stand_ins.run("ball.glb", "-o", "new")
    with pytest.raises(PrtbakeError, match=r"missing\.hdr: there is no such file"):
        stand_ins.run("ball.glb", "-o", "new", "--material", "jade", "--size", "5cm", "--light", "missing.hdr")
    with pytest.raises(typer.BadParameter, match="would look like stone; add its size") as error:
        stand_ins.run("ball.glb", "-o", "new", "--material", "jade")
    assert not Path("new").exists()
    assert "such as --size 6cm (--size 2000mm keeps it)" in str(error.value)
    assert len(stand_ins.run("ball.glb", "-o", "new", "--material", "jade", "--size", "2000mm")) == 4


def test_clear_and_opaque_objects_get_a_remark_in_every_form(stand_ins, capsys):
    """With the size of a mesh, without it, and as a scene. Without a size nobody has asked for an opaque object."""
    ball = trimesh.load("ball.obj")
    ball.apply_scale(0.002)
    ball.export("tiny.glb")  # 4 mm
    for number, mesh in enumerate((["ball.obj", "--size", "4mm"], ["tiny.glb"])):
        stand_ins.run(mesh[0], "-o", f"clear{number}", "--material", "jade", *mesh[1:])
        scene = f"clear{number}/{mesh[0][:4]}.toml"
        said = capsys.readouterr().err
        remark = f"remark: {scene}: it is almost clear: the transport mean free path is 3.03, 2.25, 3.08 mm in an obj"
        assert said.count(remark) == 1
        assert "here a longest side of 15 to 150 mm, or 3.8 to 38 times the sigma_t (of a material, density)" in said
        stand_ins.run(scene, "-o", f"again{number}")
        assert remark in capsys.readouterr().err
    stand_ins.run("ball.obj", "-o", "stone", "--material", "jade", "--size", "9m")
    assert capsys.readouterr().err.count("stone/ball.toml: it will look opaque") == 1
    stand_ins.run("wax.toml", "-o", "out")
    assert "remark" not in capsys.readouterr().err


def test_a_model_to_start_from_reaches_the_training_and_belongs_to_the_folder(stand_ins):
    earlier = Path("earlier.pt")
    earlier.write_bytes(b"weights")
    stand_ins.run("wax.toml", "-o", "out", "--from", earlier)
    assert stand_ins.start == earlier
    assert stand_ins.run("wax.toml", "-o", "out", "--from", earlier) == []
    with pytest.raises(PrtbakeError, match="out: was made with another --from, or without it; give the same, or"):
        stand_ins.run("wax.toml", "-o", "out")
    with pytest.raises(PrtbakeError, match="--from"):
        stand_ins.run("wax.toml", "-o", "out", "--from", "out/model.pt", "--force")
    assert Path("out/model.pt").read_bytes() == b"half"
