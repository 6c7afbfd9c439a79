"""Scenes of several parts: nesting, boundaries, textures, and errors that name the key."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from formats.errors import ImageError, InputWarning, SceneError
from formats.image import write_image
from formats.mesh import Mesh, read_mesh, write_mesh
from formats.scene import read_scene
from prt_bake.inspection.files import find_faults, find_remarks
from tests.tracer.scenes import moved, sphere

OUTER = '[object]\nmesh = "glass.ply"\n[interface]\neta = 1.5\n[medium]\nsigma_t = 0\nalbedo = 1\n'
LIQUID = '[[inside]]\nname = "liquid"\nmesh = "liquid.ply"\n[inside.interface]\neta = 1.33\nroughness = 0.1\n'
LIQUID += 'normals = "vertex"\nenergy_compensation = true\n[inside.medium]\nsigma_t = [1, 2, 3]\nalbedo = 0.9\n'
SEED = '[[inside]]\nname = "seed"\nmesh = "seed.ply"\nin = "liquid"\nsurface = "diffuse"\nreflectance = 0.5\n'
BUBBLE = '[[inside]]\nname = "bubble"\nmesh = "seed.ply"\nin = "liquid"\n'
PLAIN = '[[inside]]\nname = "plain"\nmesh = "seed.ply"\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    ball = sphere(1)
    for name, radius in (("glass", 1.0), ("liquid", 0.8), ("seed", 0.2)):
        write_mesh(moved(ball, radius), folder / f"{name}.ply")
    write_mesh(moved(ball, 0.2, 3.0), folder / "far.ply")
    seed = moved(ball, 0.2)
    write_mesh(Mesh(seed.positions, seed.faces, seed.normals, uv=seed.positions[:, :2]), folder / "unwrapped.ply")
    Image.fromarray(np.array([[0, 51], [102, 255]], np.uint8)).save(folder / "alpha.png")
    Image.fromarray(np.array([[[188, 0, 255]]], np.uint8)).save(folder / "colour.png")
    write_image(folder / "linear.exr", np.array([[[0.25, 0.5, 1.0]]]))
    write_image(folder / "bright.exr", np.array([[[0.25, 0.5, 1.5]]]))
    return folder


def scene(folder, text):
    (folder / "scene.toml").write_text(text)
    return read_scene(folder / "scene.toml")


def test_parts_are_read_in_file_order(folder):
    read = scene(folder, OUTER + LIQUID + SEED)
    assert [part.name for part in read.parts] == ["object", "liquid", "seed"]
    assert [part.parent for part in read.parts] == [-1, 0, 1]
    outer, liquid, seed = read.parts
    assert outer.mesh is read.mesh
    assert (liquid.eta, liquid.roughness, liquid.normals, liquid.energy_compensation) == (1.33, 0.1, "vertex", True)
    assert liquid.medium.sigma_t.tolist() == [1, 2, 3]
    assert liquid.medium.albedo.tolist() == [0.9] * 3
    assert liquid.diffuse is None
    assert (seed.diffuse.tolist(), seed.medium) == ([0.5] * 3, None)
    assert seed.mesh_path == folder / "seed.ply"


def test_an_inner_part_defaults_to_the_eta_of_its_parent_and_a_clear_medium(folder):
    bubble = scene(folder, OUTER + LIQUID + BUBBLE).parts[2]
    assert (bubble.eta, bubble.roughness, bubble.normals) == (1.33, 0, "face")
    assert bubble.medium.sigma_t.tolist() == 0
    assert scene(folder, OUTER + PLAIN).parts[1].eta == 1.5
    assert scene(folder, OUTER.replace("eta = 1.5", "") + PLAIN).parts[1].eta == 1


def test_a_parent_may_follow_its_child_in_the_file(folder):
    read = scene(folder, OUTER + BUBBLE + LIQUID)
    assert [(part.name, part.parent) for part in read.parts] == [("object", -1), ("bubble", 2), ("liquid", 0)]
    assert read.parts[1].eta == 1.33


@settings(max_examples=20, deadline=None, derandomize=True, database=None)
@given(parents=st.lists(st.integers(0, 11), min_size=1, max_size=11))
def test_every_tree_is_read_and_every_cycle_is_refused(folder, parents):
    parents = [min(parent, len(parents)) for parent in parents]
    names = ["object"] + [f"part {i}" for i in range(len(parents))]
    tables = [
        f'[[inside]]\nname = "{name}"\nmesh = "seed.ply"\nin = "{names[parent]}"\n'
        for name, parent in zip(names[1:], parents, strict=True)
    ]
    reaches_root = []
    for i in range(1, len(names)):
        chain = [i]
        while chain[-1] and len(chain) <= len(names):
            chain.append(parents[chain[-1] - 1])
        reaches_root.append(chain[-1] == 0)
    if all(reaches_root):
        assert [part.parent for part in scene(folder, OUTER + "".join(tables)).parts] == [-1, *parents]
    else:
        with pytest.raises(SceneError, match="nested in a cycle: 'part"):
            scene(folder, OUTER + "".join(tables))


def test_roughness_textures_are_linear_and_reflectances_are_decoded_from_srgb(folder):
    rough = LIQUID.replace("liquid.ply", "unwrapped.ply").replace("roughness = 0.1", 'roughness = "alpha.png"')
    alpha = scene(folder, OUTER + rough).parts[1].roughness
    np.testing.assert_allclose(alpha, [[0.01, 0.2], [0.4, 1]], atol=1e-15)  # 0 is raised
    textured = SEED.replace("seed.ply", "unwrapped.ply").replace('in = "liquid"\n', "").replace("0.5", '"colour.png"')
    diffuse = scene(folder, OUTER + textured).parts[1].diffuse
    np.testing.assert_allclose(diffuse, [[[0.50289, 0, 1]]], atol=1e-5)
    diffuse = scene(folder, OUTER + textured.replace("colour.png", "linear.exr")).parts[1].diffuse
    np.testing.assert_array_equal(diffuse, [[[0.25, 0.5, 1]]])


def test_the_hash_depends_on_every_part(folder):
    unwrapped = SEED.replace("seed.ply", "unwrapped.ply")
    texts = [
        OUTER,
        OUTER + LIQUID,
        OUTER + LIQUID + SEED,
        OUTER + LIQUID + SEED.replace("0.5", "0.6"),
        OUTER + LIQUID + SEED.replace('in = "liquid"\n', ""),
        OUTER + SEED.replace('in = "liquid"\n', "") + LIQUID,
        OUTER + LIQUID + unwrapped.replace("0.5", '"colour.png"'),
        OUTER + LIQUID + unwrapped.replace("0.5", '"linear.exr"'),
        OUTER + LIQUID + BUBBLE,
        OUTER + LIQUID.replace("1.33", "1.34"),
        OUTER + LIQUID.replace("[1, 2, 3]", "[1, 2, 4]"),
        OUTER + LIQUID.replace("energy_compensation = true", ""),
    ]
    assert len({scene(folder, text).content_hash for text in texts}) == len(texts)
    named = (OUTER + LIQUID + SEED).replace("liquid", "wine").replace("wine.ply", "liquid.ply")
    assert scene(folder, named).content_hash == scene(folder, OUTER + LIQUID + SEED).content_hash


FAULTS = [
    (LIQUID + LIQUID, "inside.1.name: another part is named 'liquid'"),
    (PLAIN.replace("plain", "object"), "inside.0.name: another part is named 'object'"),
    (
        LIQUID + SEED.replace('in = "liquid"', 'in = "liqid"'),
        "inside.1.in: there is no part 'liqid'; did you mean 'liq",
    ),
    (SEED.replace('"liquid"', '"x"'), "inside.0.in: there is no part 'x'; expected one of object, seed"),
    (BUBBLE.replace('"liquid"', '"bubble"'), "inside.0.in: parts are nested in a cycle: 'bubble' in 'bubble'"),
    (LIQUID + SEED + PLAIN + 'in = "seed"\n', "inside.2.in: 'plain' lies in 'seed', which is diffuse"),
    (
        SEED + "[inside.medium]\nsigma_t = 1\nalbedo = 1\n",
        "inside.0: a diffuse surface lets no light in; remove [inside.m",
    ),
    (
        SEED + "[inside.interface]\neta = 1.2\n",
        "inside.0: a diffuse surface lets no light in; remove [inside.interface]",
    ),
    (PLAIN + "reflectance = 0.5\n", 'inside.0: reflectance needs surface = "diffuse"'),
    (PLAIN + 'surface = "diffuse"\n', "inside.0: reflectance is missing"),
    (PLAIN + 'surface = "metal"\n', "inside.0.surface: expected \"diffuse\", found 'metal'"),
    (SEED.replace("0.5", "1.5"), "inside.0.reflectance: expected a number from 0 to 1"),
    (SEED.replace("surface", "surfac"), "inside.0.surfac: unknown key; did you mean 'surface'?"),
    (PLAIN + 'inside_of = "object"\n', "inside.0.inside_of: unknown key; expected one of name, mesh, in, surface, "),
    (
        PLAIN + "[inside.interface]\nroughnes = 1\n",
        "inside.0.interface.roughnes: unknown key; did you mean 'roughness'?",
    ),
    (PLAIN + "[inside.medium]\nsigma_t = -1\nalbedo = 1\n", "inside.0.medium.sigma_t: expected one number"),
    (PLAIN.replace("seed.ply", "far.ply"), "inside.0.mesh: .*far.ply lies completely outside 'object'"),
    (
        SEED.replace("0.5", '"colour.png"').replace('in = "liquid"', ""),
        "inside.0.reflectance: an image needs texture coord",
    ),
    (
        "".join(PLAIN.replace("plain", f"plain {i}") for i in range(12)),
        "inside: expected at most 12 parts including the outermost, found 13",
    ),
    (
        SEED.replace("seed.ply", "unwrapped.ply").replace('in = "liquid"', "").replace("0.5", '"bright.exr"'),
        "inside.0.reflectance: .*bright.exr has 1 of 3 values out of range, the first in row 0, column 0 is 1.5",
    ),
]


@pytest.mark.parametrize(("inside", "sentence"), FAULTS)
def test_every_error_names_its_key(folder, inside, sentence):
    with pytest.raises(SceneError) as caught:
        scene(folder, OUTER + inside)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'scene.toml'}: ")
    assert "\n" not in message
    for part in sentence.split(".*"):
        assert part in message


@pytest.mark.parametrize("value", ["5", "[1]"])
def test_parts_that_are_no_tables_are_refused_in_one_sentence(folder: Path, value: str) -> None:
    sentence = f"inside.0: expected tables [[inside]], found {value}"
    with pytest.raises(SceneError) as caught:
        scene(folder, f"inside = [{value}]\n{OUTER}")
    assert str(caught.value) == f"{folder / 'scene.toml'}: {sentence}"
    assert find_faults(folder / "scene.toml") == [str(caught.value)]


def test_a_texture_that_is_no_image_is_named(folder):
    rough = PLAIN.replace("seed.ply", "unwrapped.ply") + '[inside.interface]\nroughness = "seed.ply"\n'
    with pytest.raises(ImageError, match=r"seed\.ply"):
        scene(folder, OUTER + rough)


def test_twelve_parts_are_read(folder):
    inside = "".join(PLAIN.replace("plain", f"plain {i}") for i in range(11))
    assert len(scene(folder, OUTER + inside).parts) == 12


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_textures_need_usable_texture_coordinates(folder, value):
    mesh = read_mesh(folder / "unwrapped.ply")
    pairs = mesh.uv.copy()
    pairs[7, 1] = value
    write_mesh(dataclasses.replace(mesh, uv=pairs, corner_uv=None), folder / "bad_uv.ply")
    plain = PLAIN.replace("seed.ply", "bad_uv.ply")
    assert len(scene(folder, OUTER + plain).parts) == 2
    diffuse = SEED.replace("seed.ply", "bad_uv.ply").replace('in = "liquid"', "").replace("0.5", '"colour.png"')
    for inside, key in (
        (plain + '[inside.interface]\nroughness = "alpha.png"\n', "inside.0.interface.roughness"),
        (diffuse, "inside.0.reflectance"),
    ):
        sentence = rf"{key}: an image needs .* but \d of 240 corners of faces have .* the first at vertex 7 "
        with pytest.raises(SceneError, match=sentence):
            scene(folder, OUTER + inside)
        assert find_faults(folder / "scene.toml")[0].count("the first at vertex 7") == 1


def test_images_that_repeat_are_a_remark(folder):
    """The texture coordinates of the ball reach from −0.2 to 0.2."""
    rough = PLAIN.replace("seed.ply", "unwrapped.ply") + '[inside.interface]\nroughness = "alpha.png"\n'
    (folder / "scene.toml").write_text(OUTER + rough)
    assert any(
        "'plain': the texture coordinates go from (-0.2" in remark for remark in find_remarks(folder / "scene.toml")
    )
    (folder / "scene.toml").write_text(OUTER + PLAIN.replace("seed.ply", "unwrapped.ply"))
    assert not any("texture coordinates" in remark for remark in find_remarks(folder / "scene.toml"))


def test_a_roughness_image_whose_channels_differ_is_a_warning(folder):
    """glTF packs occlusion, roughness and metalness in red, green and blue."""
    packed = np.array([[[255, 51, 0], [255, 102, 0]]], np.uint8)
    Image.fromarray(packed).save(folder / "packed.png")
    rough = PLAIN.replace("seed.ply", "unwrapped.ply") + '[inside.interface]\nroughness = "packed.png"\n'
    with pytest.warns(InputWarning, match=r"packed\.png: its channels differ, and red is read"):
        read = scene(folder, OUTER + rough)
    assert (read.parts[1].roughness == 1.0).all()


def test_a_part_of_another_unit_is_a_warning(folder):
    write_mesh(moved(sphere(1), 800.0), folder / "millimetres.ply")
    with pytest.warns(InputWarning, match=r"millimetres\.ply is 800 times as large as 'object'.* the unit of length"):
        scene(folder, OUTER + PLAIN.replace("seed.ply", "millimetres.ply"))


@pytest.mark.parametrize(("normals", "angle", "warned"), [("vertex", 90, 1), ("vertex", 20, 0), ("face", 90, 0)])
def test_hard_edges_that_vertex_normals_round_off_are_named(tmp_path, recwarn, normals, angle, warned):
    """A ring of flat sides, each with a normal of its own; caps with those of the nearest side."""
    count = round(360 / angle)
    turn = 2.0 * np.pi * np.arange(count) / count
    rows = [f"v {np.cos(a)} {np.sin(a)} {z}" for z in (0.0, 1.0) for a in turn]
    rows += [f"vn {np.cos(a + np.pi / count)} {np.sin(a + np.pi / count)} 0" for a in turn]
    for side in range(count):
        following = (side + 1) % count
        corners = side, following, following + count, side + count
        rows.append("f " + " ".join(f"{corner + 1}//{side + 1}" for corner in corners))
    rows.append("f " + " ".join(f"{corner + 1}//{corner + 1}" for corner in range(count)[::-1]))
    rows.append("f " + " ".join(f"{count + corner + 1}//{corner + 1}" for corner in range(count)))
    (tmp_path / "prism.obj").write_text("\n".join([*rows, ""]))
    scene(tmp_path, OUTER.replace("glass.ply", "prism.obj").replace("1.5", f'1.5\nnormals = "{normals}"'))
    found = [str(warning.message) for warning in recwarn]
    assert len(found) == warned
    if warned:
        assert "interface.normals: " in found[0]
        assert "at 8 of 8 vertices its normals differ by more than 30 degrees" in found[0]


@pytest.mark.parametrize(("size", "warned"), [(1e-3, 1), (0.01, 0)])
def test_a_part_much_smaller_than_its_parent_is_named(folder, recwarn, size, warned):
    write_mesh(moved(sphere(1), size), folder / "dot.ply")
    scene(folder, OUTER + PLAIN.replace("seed.ply", "dot.ply"))
    assert [str(warning.message).endswith("check the unit of length") for warning in recwarn] == [True] * warned
