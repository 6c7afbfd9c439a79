"""Scene files: their values, their files, and errors that name the key."""

import codecs
import shutil
import unicodedata

import numpy as np
import pytest

from formats.errors import InputWarning, MeshError, PrtbakeError, SceneError, StorageError
from formats.mesh import build_mesh, flipped, signed_volume, write_mesh
from formats.scene import read_scene
from prt_bake.inspection.files import find_faults, find_remarks

SCENE = """
[object]
mesh = "ball.ply"
up = "z"
unit = "cm"
[interface]
eta = 1.3
roughness = 0.25
normals = "vertex"
[medium]
sigma_t = 12.0
albedo = [0.98, 0.90, 0.75]
phase_g = 0.3
bounds = [[-1, -1, -1], [1, 1, 2]]
"""


@pytest.fixture
def folder(tmp_path):
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
    mesh = build_mesh(positions, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    write_mesh(mesh, tmp_path / "ball.ply")
    write_mesh(flipped(mesh), tmp_path / "inside_out.ply")
    write_mesh(build_mesh(positions, mesh.faces[1:]), tmp_path / "open.ply")
    write_mesh(build_mesh(2 * positions, mesh.faces), tmp_path / "larger.ply")
    one_flipped = mesh.faces.copy()
    one_flipped[0] = one_flipped[0][::-1]
    write_mesh(build_mesh(positions, one_flipped), tmp_path / "one_flipped.ply")
    grid = np.random.default_rng(2).random((2, 3, 4), np.float32)
    np.save(tmp_path / "grid.npy", grid)
    np.save(tmp_path / "colour.npy", np.stack([grid] * 3, axis=3))
    return tmp_path


def scene(folder, old="", new=""):
    assert old in SCENE
    path = folder / "scene.toml"
    path.write_text(SCENE.replace(old, new, 1) if old else SCENE + new)
    return read_scene(path)


def test_all_keys_are_read(folder):
    read = scene(folder)
    assert (read.up, read.unit, read.eta, read.roughness, read.normals) == ("z", "cm", 1.3, 0.25, "vertex")
    assert (read.sigma_t, read.albedo.tolist(), read.phase_g) == (12, [0.98, 0.9, 0.75], 0.3)
    assert len(read.parts) == 1
    assert (read.parts[0].name, read.parts[0].parent, read.parts[0].diffuse) == ("object", -1, None)
    assert read.parts[0].energy_compensation is False
    assert (read.bounds, read.flipped, len(read.mesh.faces)) == (None, False, 4)
    assert read.mesh_path == folder / "ball.ply"
    assert read.tables.medium.sigma_t == 12


def test_optional_keys_have_defaults(folder):
    (folder / "scene.toml").write_text('[object]\nmesh = "ball.ply"\n[medium]\nsigma_t = 0\nalbedo = 1\n')
    read = read_scene(folder / "scene.toml")
    assert (read.up, read.eta, read.roughness, read.normals, read.phase_g) == ("y", 1, 0, "face", 0)
    assert read.albedo.tolist() == [1, 1, 1]


def test_grids_are_loaded_exactly(folder):
    read = scene(folder, "12.0", '"grid.npy"')
    np.testing.assert_array_equal(read.sigma_t, np.load(folder / "grid.npy").astype(np.float64))
    np.testing.assert_array_equal(read.bounds, [[-1, -1, -1], [1, 1, 2]])
    assert scene(folder, "[0.98, 0.90, 0.75]", '"colour.npy"').albedo.shape == (2, 3, 4, 3)
    assert scene(folder, "[0.98, 0.90, 0.75]", '"grid.npy"').albedo.shape == (2, 3, 4)
    assert scene(folder, "12.0", '"colour.npy"').sigma_t.shape == (2, 3, 4, 3)


def test_extinction_may_differ_by_channel(folder):
    read = scene(folder, "12.0", "[1, 2.5, 3]")
    assert read.sigma_t.tolist() == [1, 2.5, 3]
    assert read.sigma_t.dtype == np.float64
    assert read.content_hash != scene(folder, "12.0", "[3, 2.5, 1]").content_hash


def test_a_mesh_wound_inside_out_is_flipped(folder):
    read = scene(folder, "ball.ply", "inside_out.ply")
    assert read.flipped
    assert signed_volume(read.mesh) > 0
    np.testing.assert_allclose(read.mesh.normals, scene(folder).mesh.normals, atol=1e-15)


def test_the_hash_depends_on_what_affects_the_transport(folder):
    same = scene(folder).content_hash
    assert scene(folder, 'unit = "cm"', 'unit = "mm"').content_hash == same
    assert scene(folder, "0.98, 0.90", "0.98, 0.9").content_hash == same
    assert scene(folder, "ball.ply", "inside_out.ply").content_hash == same
    changes = [("1.3", "1.31"), ("0.25", "0.2"), ("vertex", "face"), ("12.0", "13"), ("0.75", "0.76"), ("0.3", "0")]
    changes += [("12.0", '"grid.npy"'), ("[0.98, 0.90, 0.75]", '"grid.npy"'), ("ball.ply", "larger.ply")]
    changes += [("0.25", "0.25\nenergy_compensation = true"), ("12.0", "[12, 12, 12]")]
    hashes = {scene(folder, *change).content_hash for change in changes}
    assert len(hashes | {same}) == len(changes) + 1


FAULTS = [
    ("albedo", "albdo", "medium.albdo: unknown key; did you mean 'albedo'?"),
    ("[medium]", "[medum]", "medum: unknown key; did you mean 'medium'?"),
    (
        "phase_g",
        'colour = "red"\nphase_g',
        "medium.colour: unknown key; expected one of material, density, sigma_t, albedo, phase_g, bounds, mix",
    ),
    (
        "sigma_t =",
        "sigma_s = 1\nsigma_t =",
        "medium.sigma_s: unknown key; give the extinction sigma_t = sigma_s + sigma_a",
    ),
    ("albedo =", "sigma_a =", "medium.sigma_a: unknown key; give .* and the albedo = sigma_s / sigma_t"),
    ("12.0", '"12.0"', "medium.sigma_t: there is no file '12.0'; a number has no quotes: sigma_t = 12.0"),
    ("0.25", '"0.25"', "interface.roughness: there is no file '0.25'; a number has no quotes: roughness = 0.25"),
    ("sigma_t = 12.0", "", "medium.sigma_t: is missing"),
    (
        "12.0",
        "-1",
        "medium.sigma_t: expected one number that is not negative, three of them (RGB), or the name of an .npy",
    ),
    ("12.0", "nan", "medium.sigma_t: expected one number"),
    ("12.0", "inf", "medium.sigma_t: expected one number"),
    ("12.0", "true", "medium.sigma_t: expected one number"),
    ("12.0", "1979-05-27", "medium.sigma_t: expected one number"),
    ("12.0", "[1, 2]", "medium.sigma_t: expected one number that is not negative, three of them (RGB)"),
    ("12.0", "[1, 2, -3]", "medium.sigma_t: expected one number that is not negative, three of them (RGB)"),
    ("12.0", '"ball.ply"', "is not an .npy array"),
    ("[0.98, 0.90, 0.75]", "1.01", "medium.albedo: expected a number from 0 to 1"),
    ("[0.98, 0.90, 0.75]", "[0.5, 0.5]", "medium.albedo: expected a number from 0 to 1, three of them"),
    ("[0.98, 0.90, 0.75]", "[0.5, -0.5, 0.5]", "medium.albedo: expected a number from 0 to 1, three of them"),
    ("0.3", "1.0", "medium.phase_g: expected a mean cosine between -1 and 1"),
    ("1.3", "0", "interface.eta: expected an index"),
    ("0.25", "1.5", "interface.roughness: expected a GGX alpha"),
    ('"vertex"', '"smooth"', 'interface.normals: expected "face" or "vertex", found \'smooth\''),
    ('"z"', '"x"', 'object.up: expected "y" or "z", found \'x\''),
    ("[1, 1, 2]", "[1, 1, -1]", "medium.bounds: the lowest corner must come first"),
    ("[1, 1, 2]", "[1, 1]", "medium.bounds: expected two corners"),
    ("12.0", "1e308", "medium.sigma_t: an extinction of 1e+308 per scene unit makes the part .* mean free paths long"),
    ("12.0", "1.1e9", "makes the part 1.1e+09 mean free paths long; expected at most 1e+09"),
    (
        "sigma_t = 12.0\nalbedo = [0.98, 0.90, 0.75]",
        'material = "marble"\ndensity = 1e308',
        "medium.density: an extinction of inf",
    ),
    ("[1, 1, 2]", "[1, 1, 1e300]", "medium.bounds: expected two corners"),
    ("= 12.0", "= = 12", "is not TOML"),
    ("= 12.0", "= " + 5000 * "9", "is not TOML"),
    ('mesh = "ball.ply"', 'mesh = "open.ply"', "object.mesh: .*open.ply does not bound a solid: 3 edges are open"),
    (
        'mesh = "ball.ply"',
        'mesh = "one_flipped.ply"',
        "object.mesh: .*flipped.ply does not bound a solid: 3 edges lie between faces of opposite winding",
    ),
    ("0.25", '"alpha.png"', "interface.roughness: an image needs texture coordinates, but the mesh has none"),
    ("0.25", '0.25\nenergy_compensation = "yes"', "interface.energy_compensation: expected true or false"),
]


@pytest.mark.parametrize(("old", "new", "sentence"), FAULTS)
def test_every_error_names_its_key(folder, old, new, sentence):
    with pytest.raises(SceneError) as caught:
        scene(folder, old, new)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'scene.toml'}: ")
    assert "\n" not in message
    for part in sentence.split(".*"):
        assert part in message


def test_find_faults_reports_all_keys(folder):
    text = SCENE.replace("0.25", "7").replace("12.0", "[-1, 2]").replace("unit =", "unti =").replace("0.3", '"x"')
    (folder / "scene.toml").write_text(text)
    keys = [
        fault.removeprefix(f"{folder / 'scene.toml'}: ").split(":")[0] for fault in find_faults(folder / "scene.toml")
    ]
    assert keys == ["object.unti", "interface.roughness", "medium.sigma_t", "medium.phase_g"]
    (folder / "scene.toml").write_text(SCENE.replace("ball.ply", "none.ply"))
    (missing,) = find_faults(folder / "scene.toml")
    assert "none.ply: there is no such file" in missing
    (folder / "scene.toml").write_text(SCENE)
    assert find_faults(folder / "scene.toml") == []


def test_a_lights_file_is_refused(folder):
    (folder / "sun.toml").write_text("[[directional]]\ndirection = [0, 1, 0]\n")
    with pytest.raises(SceneError, match=r"sun\.toml: is a lights file; expected a scene"):
        read_scene(folder / "sun.toml")


def test_grids_out_of_range_are_refused_with_count_and_position(folder):
    grid = np.full((2, 3, 4), 0.5)
    grid[1, 2, 3], grid[1, 0, 0] = np.nan, -2
    np.save(folder / "bad.npy", grid)
    with pytest.raises(
        SceneError, match=r"medium\.sigma_t: .*bad\.npy has 2 of 24 values .*first at \[1, 0, 0\] is -2"
    ):
        scene(folder, "12.0", '"bad.npy"')
    np.save(folder / "bad.npy", np.full((2, 2, 2), 1.5))
    with pytest.raises(SceneError, match="expected values from 0 to 1"):
        scene(folder, "[0.98, 0.90, 0.75]", '"bad.npy"')
    np.savez(folder / "bad.npz", grid=grid)
    with pytest.raises(SceneError, match=r"bad\.npz is an archive of arrays \(\.npz\); save its array alone"):
        scene(folder, "12.0", '"bad.npz"')
    for wrong in (np.zeros((2, 3)), np.zeros((2, 3, 4, 2)), np.zeros((0, 3, 4)), np.array(["a"]), np.zeros(3, complex)):
        np.save(folder / "bad.npy", wrong)
        with pytest.raises(SceneError, match=r"bad\.npy"):
            scene(folder, "12.0", '"bad.npy"')


def test_a_pickled_grid_is_refused_and_never_executed(folder):
    np.save(folder / "bad.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(SceneError, match=r"bad\.npy"):
        scene(folder, "12.0", '"bad.npy"')


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("ball.ply", "none.ply", r"object\.mesh: .*none\.ply: there is no such file"),
        ("ball.ply", "grid.npy", r"object\.mesh: .*grid\.npy: is not a readable mesh"),
        ("12.0", '"none.npy"', r"medium\.sigma_t: .*none\.npy: there is no such file"),
    ],
)
def test_errors_of_a_file_name_the_key_that_names_it(folder, old, new, sentence):
    with pytest.raises(PrtbakeError, match=rf"scene\.toml: {sentence}"):
        scene(folder, old, new)


def test_a_grid_outside_the_object_gives_a_remark(folder):
    (folder / "scene.toml").write_text(
        SCENE.replace("12.0", '"grid.npy"').replace("[[-1, -1, -1], [1, 1, 2]]", "[[1, 0, 0], [2, 1, 1]]")
    )
    (remark,) = (remark for remark in find_remarks(folder / "scene.toml") if "does not overlap" in remark)
    assert "'object': the grids' box [[1.0, 0.0, 0.0], [2.0, 1.0, 1.0]] does not overlap the part's box" in remark


def test_a_grid_needs_its_box(folder):
    (folder / "scene.toml").write_text(SCENE.replace("12.0", '"grid.npy"').replace("bounds", "#"))
    with pytest.raises(SceneError, match=r"medium\.bounds: is missing; a grid needs its box"):
        read_scene(folder / "scene.toml")


def test_missing_and_damaged_files_are_named(folder):
    with pytest.raises(StorageError, match=r"nowhere\.npy: there is no such file"):
        scene(folder, "12.0", '"nowhere.npy"')
    with pytest.raises(StorageError, match=r"nowhere\.ply: there is no such file"):
        scene(folder, "ball.ply", "nowhere.ply")
    with pytest.raises(StorageError, match=r"nowhere\.toml: there is no such file"):
        read_scene(folder / "nowhere.toml")
    with pytest.raises(MeshError, match=r"grid\.npy"):
        scene(folder, "ball.ply", "grid.npy")
    (folder / "binary.toml").write_bytes(b"\x89PNG\xff")
    with pytest.raises(SceneError, match="expected UTF-8 text"):
        read_scene(folder / "binary.toml")


def test_a_byte_order_mark_changes_nothing_and_other_encodings_are_named(folder):
    (folder / "plain.toml").write_text(SCENE)
    (folder / "marked.toml").write_bytes(codecs.BOM_UTF8 + SCENE.encode())
    assert read_scene(folder / "marked.toml").content_hash == read_scene(folder / "plain.toml").content_hash
    for encoding in ("UTF-16", "UTF-32"):
        (folder / "wide.toml").write_bytes(SCENE.encode(encoding))
        with pytest.raises(SceneError, match=f"wide.toml: expected text in UTF-8, found {encoding}"):
            read_scene(folder / "wide.toml")


def test_a_mesh_of_cubes_that_touch_along_an_edge_is_read(folder):
    quads = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    cube = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    for offset, fault in (((1, 1, 0), None), ((1, 0, 0), "2 faces lie on other faces"), ((0, 0, 0), "12 faces lie on")):
        twins = build_mesh(np.concatenate([cube, cube + offset]).astype(float), np.concatenate([faces, faces + 8]))
        write_mesh(twins, folder / "twins.ply")
        if fault is None:
            with pytest.warns(InputWarning, match="at 2 of 14 vertices its normals differ"):  # where the cubes touch
                assert len(scene(folder, "ball.ply", "twins.ply").mesh.positions) == 14
        else:
            with pytest.raises(SceneError, match=f"object.mesh: .*twins.ply does not bound a solid: {fault}"):
                scene(folder, "ball.ply", "twins.ply")


@pytest.mark.parametrize(
    ("shape", "bounds", "remark"),
    [
        ((8, 6, 4), "[[-4, -3, -2], [4, 3, 2]]", "are 2 by 1 by 0.5; as [X,Y,Z] they would be cubes"),
        ((4, 6, 8), "[[-4, -3, -2], [4, 3, 2]]", None),
        ((4, 4, 4), "[[-1, -1, -1], [1, 1, 1]]", None),
        ((4, 6, 8), "[[-4000, -3000, -2000], [4000, 3000, 2000]]", "is smaller than a cell of the grids"),
        ((4, 6, 8), "[[0, 0, 0], [0.08, 0.06, 0.04]]", "the rest is filled with border values"),
    ],
)
def test_grids_of_another_order_or_unit_give_a_remark(folder, shape, bounds, remark):
    np.save(folder / "grid.npy", np.ones(shape))
    text = SCENE.replace("12.0", '"grid.npy"').replace("[[-1, -1, -1], [1, 1, 2]]", bounds)
    (folder / "scene.toml").write_text(text)
    found = [one for one in find_remarks(folder / "scene.toml") if "'object': the " in one]
    assert len(found) == (remark is not None)
    assert not remark or remark in found[0]


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_may_have_another_normal_form_than_the_files(folder, form):
    """On macOS a file may be named with é of one character and found with é of two."""
    other = {"NFC": "NFD", "NFD": "NFC"}[form]
    place = folder / unicodedata.normalize(form, "kugel é")
    place.mkdir(exist_ok=True)
    for name in ("ball.ply", "grid.npy"):
        shutil.copy(folder / name, place / unicodedata.normalize(form, f"ü {name}"))
    named = [unicodedata.normalize(other, f"kugel é/ü {name}") for name in ("ball.ply", "grid.npy")]
    read = scene(folder, "ball.ply", named[0])
    assert (read.mesh_path.exists(), len(read.mesh.positions)) == (True, len(scene(folder).mesh.positions))
    assert scene(folder, "12.0", f'"{named[1]}"').sigma_t.ndim >= 3


def test_backslashes_between_folders_are_named(folder):
    with pytest.raises(StorageError, match=r"there is no such file; write / in place of \\ between folders"):
        scene(folder, '"ball.ply"', "'models\\ball.ply'")
