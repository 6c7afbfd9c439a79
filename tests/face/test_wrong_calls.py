"""Arguments of the wrong kind are refused by name, before any work, with what was found."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import prt_bake as prt
from formats.errors import PrtbakeError
from formats.scene import read_scene
from tests import ROOT
from tests.bakers.transports import Lobed
from tests.shading.test_picture import make_asset
from tests.shapes import ball

MESH = ball(2)
ASSET = make_asset(MESH)
BALL = trimesh.Trimesh(MESH.positions, MESH.faces, process=False)
NETWORK = prt.NeuralBSSRDF(box_min=(-1.0, -1.0, -1.0), box_side=2.0)
LIGHT, SKY = np.ones((9, 3)), np.ones((8, 16, 3), np.float32)
CAMERA = prt.fit_camera(MESH, 8, 8)
LIGHTING = prt.read_lighting("sun:0,1,0")
BYTES = np.full((8, 16, 3), 200, np.uint8)
GRADIENT = torch.ones(8, 16, 3, requires_grad=True)
FEW: Any = {"rings": 1, "sectors": 4, "samples": 18}
X, UP = [[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0]]


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return read_scene(ROOT / "prt_bake" / "shipped" / "spot.toml")


def bake(**arguments: Any) -> Any:
    return prt.bake(**({"transport": Lobed(), "mesh": MESH} | FEW | arguments))


def shade(*arguments: Any) -> Any:
    return prt.shade(*arguments, *(ASSET, LIGHT, [0.0, 0.0, 9.0])[len(arguments) :])


def picture(*arguments: Any, **more: Any) -> Any:
    return prt.render_picture(*arguments, *(ASSET, SKY, CAMERA)[len(arguments) :], **more)


def exits(**arguments: Any) -> Any:
    scene = read_scene(ROOT / "prt_bake" / "shipped" / "spot.toml")
    place = scene.mesh.positions[:1], scene.mesh.normals[:1]
    return prt.estimate_coefficients(scene, *place, degree=0, paths=2, **arguments)


def project(image: Any = SKY, degree: Any = 2) -> Any:
    return prt.project_environment(image, degree)


ENCODED = "expected linear radiance in floating point, found {}, which .* encoded for display; prt.read_image"

WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "mesh none": (lambda: bake(mesh=None), r"mesh: expected what prt.read_mesh\(path\) returns, found None"),
    "mesh array": (lambda: bake(mesh=MESH.positions), r"mesh: .* found an array \[\d+, 3\] of float64"),
    "mesh asset": (lambda: bake(mesh=ASSET), "mesh: .* found an asset; give its .mesh"),
    "mesh trimesh scene": (lambda: bake(mesh=trimesh.Scene(BALL)), "found a trimesh Scene; give one mesh"),
    "transport none": (lambda: bake(transport=None), "transport: expected what prt.load_model.*, found None"),
    "transport swapped": (lambda: prt.bake(MESH, NETWORK, **FEW), "transport: .*, found a mesh"),
    "transport module": (lambda: bake(transport=torch.nn.Linear(7, 3)), "transport: .*, found Linear"),
    "transport path": (lambda: bake(transport=Path("a.pt")), r"prt.load_model\(path\) returns, found the path a.pt"),
    "degree float": (lambda: bake(degree=2.0), "degree must be a whole number, found 2.0"),
    "degree text": (lambda: bake(degree="2"), "degree must be a whole number, found the text '2'"),
    "degree bool": (lambda: bake(degree=True), "degree must be a whole number, found True"),
    "error text": (lambda: bake(error="0.1"), "error must be a number, found the text '0.1'"),
    "minutes list": (lambda: bake(minutes=[1]), "minutes must be a number, found a list"),
    "seed": (lambda: bake(seed=-1), "seed must be at least 0, found -1"),
    "no gpu": (
        lambda: bake(device="cuda"),
        "device: expected 'cpu', or 'cuda' with a GPU .*, found 'cuda'; give 'cpu'",
    ),
    "no such device": (lambda: bake(device="gpu"), "device: expected 'cpu', .* found 'gpu'"),
    "no device": (lambda: bake(device=None), "device: expected 'cpu', .* found None"),
    "out": (lambda: bake(out=3), "out: expected the path of a file, found 3"),
    "for light": (
        lambda: bake(for_light="sky.hdr"),
        r"for_light: expected coefficients of shape \[K, 3\], .* 'sky.hdr'",
    ),
    "for eye": (
        lambda: bake(for_eye="0,1,4"),
        r"for_eye: expected numbers such as \[0, 1, 4\], found the text '0,1,4'",
    ),
    "progress": (lambda: bake(progress=3), "progress: expected a function, found 3"),
    "leave out": (lambda: bake(leave_out=None), "leave_out: expected a collection of names, found None"),
    "provenance": (lambda: bake(provenance="x"), "provenance: expected a dictionary, found the text 'x'"),
    "nan mesh": (
        lambda: bake(mesh=prt.Mesh(MESH.positions * np.nan, MESH.faces, MESH.normals)),
        r"mesh: \d+ of \d+ vertices are not finite, the first is number 0",
    ),
    "mesh from 1": (
        lambda: prt.Mesh(MESH.positions, MESH.faces + 1, MESH.normals),
        "faces: expected indices from 0 to",
    ),
    "mesh floats": (lambda: prt.Mesh(MESH.positions, MESH.faces + 0.5, MESH.normals), "faces: expected whole numbers"),
    "mesh normals": (lambda: prt.Mesh(MESH.positions, MESH.faces, None), "normals: expected real numbers, found None"),
    "empty trimesh": (lambda: bake(mesh=trimesh.Trimesh()), "expected faces, found none in the trimesh mesh"),
    "sky path": (lambda: project("sky.hdr"), r"image: expected what prt.read_image\(path\) returns, found the path"),
    "sky none": (lambda: project(None), "image: expected real numbers, found None"),
    "sky bytes": (lambda: project(BYTES), "image: " + ENCODED.format("uint8 values")),
    "sky 16 bits": (lambda: project(BYTES.astype(np.uint16)), "image: " + ENCODED.format("uint16 values")),
    "sky PIL": (lambda: project(Image.fromarray(BYTES)), "image: " + ENCODED.format("a PIL image")),
    "sky complex": (lambda: project(SKY * 1j), "image: expected real numbers, found complex64 values"),
    "sky lighting": (lambda: project(LIGHTING), "image: expected real numbers, found a lighting"),
    "sky ragged": (
        lambda: project([[1.0], [1.0, 2.0]]),
        "image: expected numbers in an array of one shape, found a list",
    ),
    "sky degree": (lambda: project(degree=2.0), "degree must be a whole number, found 2.0"),
    "sky degree none": (lambda: project(degree=None), "degree must be a whole number, found None"),
    "high degree": (lambda: project(degree=500), "degree: rotations are computed up to degree 100, found 500"),
    "turned sky": (
        lambda: prt.rotate_light(SKY, 90),
        r"coefficients: expected coefficients of shape \[K, 3\], .*found an",
    ),
    "turned text": (lambda: prt.rotate_light(LIGHT, "90"), "degrees must be a number, found the text '90'"),
    "turned nan": (lambda: prt.rotate_light(LIGHT, np.nan), "degrees: expected a finite number, found nan"),
    "asset model": (lambda: shade(NETWORK), "asset: expected an asset, found a model; bake it first: prt.bake"),
    "asset mesh": (lambda: shade(MESH), r"asset: expected what prt.read_asset\(path\) returns, found a mesh"),
    "asset none": (lambda: prt.compress(None, 0.1), "asset: .* found None"),
    "light lighting": (
        lambda: shade(ASSET, LIGHTING),
        r"light: expected what prt.light_for\(asset, .* found a lighting",
    ),
    "light text": (lambda: shade(ASSET, LIGHT.astype(str)), "light: expected real numbers, found <U"),
    "light none": (lambda: shade(ASSET, None), r"light: expected shape \[9, 3\]"),
    "eye text": (
        lambda: shade(ASSET, LIGHT, "0,1,4"),
        r"eye: expected numbers such as \[0, 1, 4\], found the text '0,1,4'",
    ),
    "eye nan": (
        lambda: shade(ASSET, LIGHT, [0, np.nan, 4]),
        r"eye: expected a point of three finite numbers, found \[0.0, nan, 4.0\]",
    ),
    "eye camera": (lambda: shade(ASSET, LIGHT, CAMERA), r"eye: expected real numbers, found a camera; give its \.eye"),
    "up vector": (lambda: prt.fit_camera(MESH, 8, 8, up=[0, 1, 0]), 'up: expected "y" or "z", .* found a list'),
    "flag text": (lambda: picture(ASSET, SKY, reflection="no"), "reflection: expected True or False, found the text"),
    "asset name": (
        lambda: bake(out="a.png"),
        r"out: expected a name that ends in \.h5 or \.hdf5, found the text 'a.png'",
    ),
    "key share": (
        lambda: exits(keys=[0.5]),
        r"keys: expected whole numbers from 0 on, found an array \[1\] of float64",
    ),
    "keys": (lambda: exits(keys=[1, 2]), r"keys: expected one for each of 1 queries, found shape \[2\]"),
    "sky integers": (
        lambda: project(BYTES.astype(int)),
        "image: expected linear .* found int64 values, which are usually",
    ),
    "camera eye": (lambda: picture(ASSET, SKY, [0, 0, 9]), r"camera: expected what prt.fit_camera\(.*, found a list"),
    "picture light": (lambda: picture(ASSET, BYTES), "light: " + ENCODED.format("uint8 values")),
    "picture model": (lambda: picture(NETWORK), "asset: expected an asset, found a model"),
    "lighting sky": (
        lambda: prt.light_for(ASSET, SKY),
        "lighting: .* found an array .*; its coefficients are prt.project",
    ),
    "lighting swapped": (lambda: prt.light_for(LIGHTING, ASSET), "asset: .* found a lighting"),
    "frames model": (lambda: prt.Frames(NETWORK), "asset: expected an asset, found a model"),
    "frames light": (lambda: prt.Frames(ASSET).light("sky.hdr"), r"light: expected what prt.light_for\(asset"),
    "camera of text": (
        lambda: prt.fit_camera("a.obj"),
        r"mesh: expected what prt.read_mesh\(path\) returns, found the path",
    ),
    "camera size": (lambda: prt.fit_camera(MESH, (640, 480)), "width must be a whole number, found a tuple"),
    "compare bytes": (lambda: prt.compare(BYTES, BYTES), "image: " + ENCODED.format("uint8 values")),
    "compare picture": (lambda: prt.compare(picture(), SKY), "image: .* found a picture; give its .image"),
    "compare mask": (
        lambda: prt.compare(SKY, SKY, "m.png"),
        "mask: expected an array of numbers, found the text 'm.png'",
    ),
    "compress": (lambda: prt.compress(ASSET, "0.1"), "error must be a number, found the text '0.1'"),
    "estimate model": (
        lambda: prt.estimate_transport(NETWORK, X, UP, UP),
        r"scene: expected what prt.load_scene\(path\)",
    ),
    "train mesh": (lambda: prt.train(MESH), "scene: .* found a mesh"),
    "render network": (lambda: prt.render_network(None, MESH, SKY, CAMERA), "network: .* found None"),
    "model path": (lambda: prt.load_model(3), "path: expected the path of a file, found 3"),
    "mesh of trimesh": (lambda: prt.read_mesh(BALL), "path: .* found a trimesh mesh; prt.Mesh.from_trimesh"),
    "scene of text": (lambda: prt.load_scene({"object": {}}), "path: expected the path of a file, found a dict"),
    "lights": (lambda: prt.read_lighting(3), "lights: expected the path of a file, found 3"),
    "write swapped": (lambda: prt.write_image(SKY, "a.png"), "path: .* found an array"),
    "write bytes": (lambda: prt.write_image("a.png", BYTES), "image: " + ENCODED.format("uint8 values")),
    "save swapped": (lambda: prt.save_model("a.pt", NETWORK), r"network: expected what prt.load_model\(path\) returns"),
    "harmonics degree": (lambda: prt.sh.evaluate(UP, 2.0), "degree must be a whole number, found 2.0"),
    "harmonics of text": (
        lambda: prt.sh.evaluate("z", 2),
        "directions: expected an array of numbers, found the text 'z'",
    ),
    "settings": (lambda: prt.NeuralBSSRDF("a"), "settings: expected NetworkSettings, found the text 'a'"),
    "evaluate shapes": (lambda: NETWORK.evaluate(UP, X * 2, UP * 3), r"found shapes \[1, 3\], \[2, 3\], \[3, 3\]"),
    "evaluate queries": (
        lambda: NETWORK.evaluate([UP, UP, UP], X, UP),
        r"incident: expected \[D,3\] or \[1,D,3\], found",
    ),
    "evaluate text": (
        lambda: NETWORK.evaluate("a", X, UP),
        "incident: expected an array of numbers, found the text 'a'",
    ),
    "turns": (lambda: prt.fit_camera(MESH, 8, 8, turns=0), "turns must be at least 1, found 0"),
    "suns": (lambda: prt.shade(ASSET, LIGHT, X[0], suns=[UP]), "suns: expected directional lights, .* found a list"),
    "roughness": (
        lambda: prt.render_picture(ASSET, SKY, CAMERA, roughness=2),
        "roughness: expected a number from 0 to 1",
    ),
    "names": (lambda: prt.compare(SKY, SKY, names="ab"), "names: expected three texts, .* found the text 'ab'"),
    "bake nan": (lambda: bake(minutes=np.nan), "minutes must be a number, found nan"),
    "importance": (
        lambda: prt.render_network(NETWORK, MESH, SKY, CAMERA, importance="a"),
        "importance: expected an importance module, found the text 'a'",
    ),
    "alpha": (
        lambda: prt.write_image("a.png", SKY, alpha=BYTES[..., 0]),
        "alpha: expected coverage from 0 to 1, found uint8 from 200 to 200",
    ),
    "layers": (lambda: prt.write_image("a.exr", SKY, layers=[1]), "layers: expected a dictionary, found a list"),
    "bins": (lambda: prt.sphere.view_bins(2.0, 4), "rings must be a whole number, found 2.0"),
    "frame of text": (
        lambda: prt.sphere.tangent_frame("a"),
        "normals: expected an array of numbers, found the text 'a'",
    ),
    "degree of": (lambda: prt.sh.degree_of("9"), "count must be a whole number, found the text '9'"),
    "evaluate long": (
        lambda: NETWORK.evaluate(UP, X, [[0, 0, 5.0]]),
        "outgoing: expected unit vectors, found one of length 5",
    ),
    "class": (lambda: bake(transport=Lobed), r"transport: expected an object, found the class Lobed; give Lobed\(…\)"),
    "scheduler": (lambda: bake(scheduler=3), "scheduler: expected a text, found 3"),
    "srgb nan": (lambda: prt.srgb([[np.nan, 0, 0]]), "image: expected numbers, found 1 that are NaN"),
    "from trimesh": (
        lambda: prt.Mesh.from_trimesh("a.obj"),
        "mesh: expected a mesh of trimesh, found the text 'a.obj'",
    ),
    "seed huge": (lambda: bake(seed=2**70), "seed must be at most 9,223,372,036,854,775,807, found 1,180"),
    "seed share": (lambda: bake(seed=1.5), "seed must be a whole number, found 1.5"),
    "provenance nan": (lambda: bake(provenance={"x": np.nan}), "provenance: expected texts, numbers"),
    "provenance object": (lambda: bake(provenance={"x": object()}), "provenance: expected texts, numbers, .*object"),
    "for light prepared": (
        lambda: bake(for_light=prt.light_for(ASSET, LIGHTING)),
        "for_light: .* found what prt.light_for returns",
    ),
    "for light asset": (lambda: bake(for_light=ASSET), "for_light: expected real numbers, found an asset"),
    "light masked": (
        lambda: shade(ASSET, np.ma.masked_array(LIGHT, LIGHT > 0.0)),
        r"light: expected numbers, found a masked array without 27 of them; give its .filled\(number\)",
    ),
    "light class": (lambda: prt.light_for(ASSET, prt.Lighting), "lighting: .* found the class Lighting"),
    "rotate complex": (lambda: picture(rotate=np.complex64(3.0)), "rotate must be a number, found an array"),
    "rotate huge": (lambda: picture(rotate=10**400), "rotate must be a number, found 1000"),
    "picture light prepared": (
        lambda: picture(ASSET, prt.light_for(ASSET, LIGHTING)),
        "light: .* or a lat-long picture .* found what prt.light_for returns",
    ),
    "picture lights": (lambda: picture(ASSET, [LIGHTING, LIGHTING]), r"light: .* prt.read_lighting\(\[...\]\) reads"),
    "picture layer": (lambda: picture(layers="normal"), "layers: expected names such as .* found the text 'normal'"),
    "picture samples": (lambda: picture(samples=100_000), "samples must be at most 256, found 100,000"),
    "normals": (lambda: picture(normals="smooth"), 'normals: expected one of "vertex", "face", found the text'),
    "cube map": (lambda: project(np.ones((8, 48, 3))), r"image: is a cube map \(6x1 squares\)"),
    "lights bytes": (lambda: prt.read_lighting(b"sun:0,1,0"), "lights: expected the path of a file, found a bytes"),
    "sun of letters": (lambda: prt.read_lighting("sun:up"), "^light sun:up: expected sun:x,y,z"),
    "mask integers": (
        lambda: prt.compare(SKY, SKY, np.full((8, 16), 200)),
        "mask: expected weights from 0 to 1, found int64 up to 200; give booleans",
    ),
    "mask rgba": (lambda: prt.compare(SKY, SKY, np.ones((8, 16, 4))), r"shape \[8, 16\], found \[8, 16, 4\]"),
    "resume a picture": (
        lambda: prt.render_network(NETWORK, MESH, SKY, CAMERA, resume=True),
        "resume: expected checkpoint, the file of the stopped picture, found none",
    ),
    "alpha above 1": (lambda: prt.write_image("a.png", SKY, alpha=2.0 * SKY[..., 0]), "from 0 to 1, .* from 2 to 2"),
    "alpha nan": (lambda: prt.write_image("a.exr", SKY, alpha=np.nan * SKY[..., 0]), "from 0 to 1, .* from nan"),
    "layer number": (
        lambda: prt.write_image("a.exr", SKY, layers={1: SKY}),
        "a.exr: layer: expected a name of printable characters, found 1",
    ),
    "layer RGB": (
        lambda: prt.write_image("a.exr", SKY, layers={"RGB": SKY}),
        "a.exr: layer RGB: is the name of a part of the picture; choose another",
    ),
    "layer complex": (
        lambda: prt.write_image("a.exr", SKY, layers={"x": 1j * SKY}),
        "a.exr: layer x: expected real numbers, found complex64 values",
    ),
    "attribute": (
        lambda: prt.write_image("a.exr", SKY, attributes={"x": 3}),
        "a.exr: attribute x: expected a text, found 3",
    ),
    "attribute of the format": (
        lambda: prt.write_image("a.exr", SKY, attributes={"channels": "x"}),
        "a.exr: attribute channels: is the name of a part",
    ),
    "bound to a path": (lambda: NETWORK.on("a.obj"), r"mesh: expected what prt.read_mesh\(path\) returns"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_call_names_the_argument_and_what_was_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    call, sentence = WRONG[name]
    with pytest.raises(PrtbakeError, match=sentence):
        call()


def test_a_camera_and_a_device_are_checked_before_a_scene_is_traced(scene: prt.Scene) -> None:
    with pytest.raises(PrtbakeError, match=r"camera: .* found None"):
        prt.render_scene(scene, SKY, None)
    with pytest.raises(PrtbakeError, match="device: 'tpu' is not available"):
        prt.train(scene, device="tpu")
    with pytest.raises(PrtbakeError, match="settings: expected NetworkSettings, found the text 'x'"):
        prt.train(scene, settings="x")
    with pytest.raises(PrtbakeError, match="learning: expected LearningSettings, found a camera"):
        prt.train(scene, learning=CAMERA)
    with pytest.raises(PrtbakeError, match="minutes must be a number, found nan"):
        prt.train(scene, minutes=np.nan)
    with pytest.raises(PrtbakeError, match=r"a\.h5: a model's name ends in \.pt or \.safetensors"):
        prt.train(scene, output="a.h5")
    with pytest.raises(PrtbakeError, match=r"resume: expected checkpoint, .* found none"):
        prt.render_scene(scene, SKY, CAMERA, resume=True)


def test_arguments_of_other_libraries_are_taken() -> None:
    np.testing.assert_array_equal(project(GRADIENT), project(SKY))
    np.testing.assert_array_equal(project(SKY.tolist(), np.int64(2)), project())
    half = GRADIENT.detach().bfloat16()
    np.testing.assert_array_equal(project(half), project())
    lists = shade(ASSET, torch.tensor(LIGHT, requires_grad=True), torch.tensor([0.0, 0.0, 9.0]))
    np.testing.assert_array_equal(lists, shade())
    baked = bake(mesh=BALL)
    np.testing.assert_allclose(baked.mesh.normals, BALL.vertex_normals, atol=1e-12)
    assert prt.fit_camera(BALL, 8, 8).width == 8
    assert NETWORK.on(BALL) is NETWORK


def test_a_scene_is_baked_by_its_path_tracer(scene: prt.Scene) -> None:
    with pytest.raises(PrtbakeError, match="samples must be at least 2 paths a bin"):
        prt.bake(scene, scene.mesh, rings=1, sectors=1, samples=1)


def test_meshes_go_to_trimesh_and_back() -> None:
    uv = np.linspace(0.0, 1.0, 2 * len(MESH.positions)).reshape(-1, 2)
    mesh = prt.Mesh(MESH.positions, MESH.faces, MESH.normals, uv)
    back = prt.Mesh.from_trimesh(mesh.to_trimesh())
    for name in ("positions", "faces", "normals", "uv"):
        np.testing.assert_allclose(getattr(back, name), getattr(mesh, name), atol=1e-12)


def test_python_names_a_missing_argument_itself() -> None:
    with pytest.raises(TypeError, match=r"shade\(\) missing 1 required positional argument: 'eye'"):
        prt.shade(ASSET, LIGHT)  # type: ignore[call-arg]
