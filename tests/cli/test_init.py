"""`prtbake init` and `prtbake materials`: scenes that work at once, sizes and units, and what is refused."""

import re
import shlex

import numpy as np
import pytest
import trimesh

from formats.mesh import build_mesh, flipped, read_mesh, write_mesh
from formats.scene import read_scene
from formats.scene.materials import find_material, materials
from formats.scene.schema import InsideTable, InterfaceTable, MediumTable, MixTable, ObjectTable
from prt_bake.cli.main import main
from prt_bake.inspection.files import find_faults, find_remarks


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A ball of diameter 2, one in glTF, a box with hard edges, and an open mesh."""
    folder = tmp_path_factory.mktemp("init")
    ball = trimesh.creation.icosphere(subdivisions=2)
    box = trimesh.creation.box()
    surface = build_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    write_mesh(surface, folder / "ball.obj")
    ball.export(folder / "ball.glb")
    trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False).export(
        folder / "box.obj", include_normals=True
    )
    write_mesh(build_mesh(surface.positions, surface.faces[:-2]), folder / "open.ply")
    write_mesh(flipped(surface), folder / "inverted.ply")
    turned = surface.faces[:-2].copy()
    turned[0] = turned[0, ::-1]
    write_mesh(build_mesh(surface.positions, turned), folder / "torn.ply")
    return folder


@pytest.fixture
def init(meshes, tmp_path, monkeypatch, capsys):
    """Run `prtbake init` in an empty folder on one of the meshes; return exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def run(mesh, *options):
        code = main(["init", str(meshes / mesh), *options])
        return (code, *capsys.readouterr())

    return run


def test_a_scene_has_the_size_and_the_material(init, tmp_path):
    code, out, err = init("ball.obj", "--material", "Jade", "--size", "14cm", "-o", "green stone.toml")
    assert code == 0
    scene, jade = read_scene(tmp_path / "green stone.toml"), find_material("jade")
    extent = np.ptp(scene.mesh.bounds, axis=0).max()
    np.testing.assert_allclose(extent * scene.tables.object.unit_in_mm, 140, rtol=1e-6)
    reduced = np.array(jade.sigma_s_reduced) + jade.sigma_a
    np.testing.assert_allclose(scene.sigma_t * extent, 140 * reduced, rtol=1e-6)
    assert (scene.eta, scene.roughness, scene.normals, scene.up) == (1.6, 0.15, "vertex", "y")
    assert out == (
        "green stone.toml: ball.obj in jade, 140 mm long, 45.5 to 62.3 transport mean free paths (about 5 to 50 look "
        "translucent)\n"
    )
    assert "jade is an estimate: chosen for" in err
    assert err.endswith("next: prtbake make 'green stone.toml' -o 'green stone'\n")
    assert not find_faults(tmp_path / "green stone.toml")


def test_the_numbers_in_the_comments_are_those_of_the_material(init, tmp_path):
    assert init("ball.obj", "--material", "marble", "--size", "55mm")[0] == 0
    text = (tmp_path / "ball.toml").read_text()
    named = read_scene(tmp_path / "ball.toml")
    (tmp_path / "ball.toml").write_text(
        re.sub(r"\n(material|density)[^\n]*", "", text).replace("# sigma_t", "sigma_t").replace("# albedo", "albedo")
    )
    by_number = read_scene(tmp_path / "ball.toml")
    np.testing.assert_allclose(by_number.sigma_t, named.sigma_t, rtol=1e-5)
    np.testing.assert_allclose(by_number.albedo, named.albedo, rtol=1e-5)


def test_without_a_size_the_unit_is_said(init, tmp_path):
    code, _, err = init("ball.obj", "--material", "wax")
    assert code == 0
    assert "ball.obj: the format has no unit of length; the object is taken to be 10 cm long" in err
    assert err.endswith("next: prtbake make ball.toml -o ball\n")
    assert read_scene(tmp_path / "ball.toml").tables.object.length_in_mm == pytest.approx(50)


def test_a_large_gltf_object_leads_to_a_size_that_looks_translucent(init, meshes, tmp_path, capsys):
    code, _, err = init("ball.glb", "--material", "wax", "-o", "w x.toml", "--up", "z")
    assert code == 0
    assert "ball.glb: glTF is in metres, so the object is 2000 mm long; --size changes that" in err
    assert "remark: wax of this size looks opaque, like stone; 3cm looks translucent: --size 3cm" in err
    assert read_scene(tmp_path / "w x.toml").unit == "m"
    command = f"prtbake init {meshes / 'ball.glb'} --material wax --size 3cm -o 'w x.toml' --up z --force"
    assert err.endswith(f"next: {command}\n")
    assert main(shlex.split(command)[1:]) == 0
    assert not find_remarks(tmp_path / "w x.toml")[:-1]  # but for the energy that a rough surface loses
    assert main(["check", str(meshes / "ball.glb")]) == 0
    out, err = capsys.readouterr()
    assert "ball.glb: it is 2 m long, since glTF is in metres; jade, wax or marble of that size looks opaque" in out
    assert err.endswith(f"next: prtbake init {meshes / 'ball.glb'} --material jade --size 10cm\n")


def test_the_other_keys_work_without_the_hash(init, meshes, tmp_path):
    assert init("ball.obj", "--material", "wax", "--size", "5cm")[0] == 0
    text = (tmp_path / "ball.toml").read_text()
    for table in (ObjectTable, InterfaceTable, MediumTable, MixTable, InsideTable):
        for name, field in table.model_fields.items():
            assert re.search(rf"\b{field.alias or name}\b", text), name
    before, _, rest = text.partition("# All other keys")
    keys, _, after = rest.partition("# Next, in this folder")
    lines = [line.removeprefix("# ") for line in keys.splitlines()]
    lines = [line for line in lines if re.match(r"(\[|[a-z_]+ = )", line)]
    assert len(lines) == 16
    core = read_mesh(meshes / "ball.obj")
    write_mesh(build_mesh(core.positions / 2, core.faces), tmp_path / "core.obj")
    (tmp_path / "ball.toml").write_text("\n".join([before, *lines, "#" + after]))
    assert not find_faults(tmp_path / "ball.toml")
    scene = read_scene(tmp_path / "ball.toml")
    assert scene.tables.medium.mix.pattern == "veins"
    assert [part.name for part in scene.parts] == ["object", "core"]


def test_hard_edges_keep_their_faces(init, tmp_path):
    assert init("box.obj", "--material", "soap", "--size", "6in", "--up", "z")[0] == 0
    scene = read_scene(tmp_path / "box.toml")
    assert (scene.normals, scene.up) == ("face", "z")
    assert scene.tables.object.length_in_mm == pytest.approx(152.4)


@pytest.mark.parametrize("name", materials())
def test_every_material_makes_a_sound_scene(init, tmp_path, name):
    assert init("ball.obj", "--material", name, "--size", "5cm")[0] == 0
    assert not find_faults(tmp_path / "ball.toml")


def test_faulty_meshes_are_refused_with_their_fault(init, tmp_path):
    code, _, err = init("open.ply", "--material", "wax")
    assert code == 1
    assert "open.ply: 4 edges are open" in err
    code, _, err = init("torn.ply", "--material", "wax")
    assert code == 1
    assert err.endswith(" (and 1 more: `prtbake check` lists them)\n")
    code, _, err = init("inverted.ply", "--material", "wax")
    assert code == 1
    assert "inverted.ply: the faces are wound inside out; flip the normals" in err
    assert not list(tmp_path.iterdir())


def test_a_file_of_another_kind_is_named(init, meshes):
    (meshes / "sky.hdr").write_bytes(b"#?RADIANCE")
    code, _, err = init("sky.hdr", "--material", "wax")
    assert code == 1
    assert "sky.hdr: expected a mesh (MESH), found a picture" in err


def test_an_existing_scene_is_kept(init, tmp_path):
    (tmp_path / "ball.toml").write_text("mine")
    code, _, err = init("ball.obj", "--material", "wax")
    assert code == 1
    assert err == "prtbake: ball.toml: already exists; add --force to replace it, or choose another name with -o\n"
    assert (tmp_path / "ball.toml").read_text() == "mine"
    assert init("ball.obj", "--material", "wax", "--force")[0] == 0


WRONG = {
    (): "Missing option '--material'. Choose one:\n  estimates: jade, white jade, ",
    ("--material", "marbel"): "--material: unknown material 'marbel'; did you mean 'marble'",
    ("--material", "xyzzy"): "--material: unknown material 'xyzzy'; `prtbake materials` lists all",
    ("--material", "wax", "--size", "14"): "--size: expected a positive length with its unit, such as 14cm",
    ("--material", "wax", "--size", "-1cm"): "--size: expected a positive length with its unit, such as 14cm",
}


@pytest.mark.parametrize("options", WRONG)
def test_wrong_options_are_named(init, options):
    code, _, err = init("ball.obj", *options)
    assert code == 2
    assert WRONG[options] in err


def test_the_list_of_materials_has_every_one_with_its_source(capsys):
    assert main(["materials"]) == 0
    out = capsys.readouterr().out
    assert all(f"  {material.name} " in out for material in materials().values())
    assert all(len(line) <= 100 for line in out.splitlines())
    assert out.startswith("estimates: chosen for ")
    assert "an object 5 to 50 times as long glows" in out
    assert main(["materials", "spectralon"]) == 0
    assert "0.086 0.049 0.067     inf   inf   inf   1.000 1.000 1.000  1.3" in capsys.readouterr().out
    assert main(["materials", "marbel"]) == 2
    assert "unknown material 'marbel'; did you mean 'marble'" in capsys.readouterr().err
