"""The shaders of `engines/`, run in Chromium and compared with NumPy; the compilers take them, too.

HLSL runs as what glslangValidator and spirv-cross make of it. The radiance that is compared has a sky, a sun and a
constant light in it, all turned into object space, so that every function of the files counts.
"""

import json
import re
import subprocess
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import prt_bake as prt
from tests import ROOT
from tests.engines.conftest import HERE, RunNode, program

ENGINES = ROOT / "engines"
COUNT = 50
TOLERANCE = 1e-5  # of the largest radiance: float32 of a few hundred products


@dataclass(frozen=True)
class Scene:
    """Random coefficients, an eye, lights, and an object that is turned, scaled and perhaps mirrored."""

    view_degree: int
    light_degree: int
    mirrored: bool = False
    stretched: bool = False

    @property
    def R(self) -> int:
        return (self.view_degree + 1) ** 2

    @property
    def K(self) -> int:
        return (self.light_degree + 1) ** 2

    @cached_property
    def coefficients(self) -> NDArray[np.float16]:
        return self._random(1).normal(size=(COUNT, self.R, self.K, 3)).astype(np.float16)

    @cached_property
    def texels(self) -> NDArray[np.float16]:
        """As X.exr: seven vertices a row, the last row not full."""
        rows = -(-COUNT // 7)
        texels = np.zeros((rows * 7, self.R * self.K, 3), np.float16)
        texels[:COUNT] = self.coefficients.reshape(COUNT, -1, 3)
        return texels.reshape(rows, -1, 3)

    @cached_property
    def positions(self) -> NDArray[np.float64]:
        return self._random(2).normal(size=(COUNT, 3))

    @cached_property
    def object_to_world(self) -> NDArray[np.float64]:
        turn = np.linalg.qr(self._random(3).normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn)) * (-1 if self.mirrored else 1)
        matrix = np.eye(4)
        stretch = [[1, 0.5, 0], [0, 2, 0], [0, 0, 0.7]] if self.stretched else np.eye(3)
        matrix[:3, :3], matrix[:3, 3] = 0.01 * turn @ stretch, (1, 2, 3)
        return matrix

    eye = np.array([1.5, 2.25, 3.125])
    sun = np.array([2.0, -3.0, 6.0]) / 7
    irradiance = np.array([3.0, 2.0, 1.0])
    constant = np.array([0.1, 0.2, 0.4])

    @cached_property
    def sky(self) -> NDArray[np.float64]:
        return self._random(4).normal(size=(self.K, 3))

    @property
    def vertices(self) -> NDArray[np.float64]:
        """The centre of each vertex's first texel, from 0 to 1 across the texture [V,2]."""
        height, width, _ = self.texels.shape
        row, column = np.divmod(np.arange(COUNT), 7)
        return np.stack([(column * self.R * self.K + 0.5) / width, (row + 0.5) / height], axis=1)

    @property
    def radiance(self) -> NDArray[np.float64]:
        matrix = self.object_to_world[:3, :3]
        outgoing = (self.eye - self.positions @ matrix.T - self.object_to_world[:3, 3]) @ np.linalg.inv(matrix).T
        sun = np.linalg.inv(matrix) @ self.sun
        b = self.sky + np.outer(prt.sh.evaluate(sun / np.linalg.norm(sun), self.light_degree), self.irradiance)
        b[0] += np.sqrt(4 * np.pi) * self.constant
        outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
        view = prt.sh.evaluate(outgoing, self.view_degree)
        radiance = np.einsum("vr,vrkc,kc->vc", view, self.coefficients.astype(float), b)
        assert (radiance < 0).any()
        return np.maximum(radiance, 0)

    def _random(self, seed: int) -> np.random.Generator:
        return np.random.default_rng([seed, self.view_degree, self.light_degree])


SCENES = [Scene(3, 2), Scene(8, 2, mirrored=True), Scene(2, 0), Scene(1, 3), Scene(0, 0)]


def example(language: str) -> str:
    """The block of `engines/README.md` in a language, with the file that it includes."""
    found = re.search(rf"```{language}\n(.*?)```", (ENGINES / "README.md").read_text("utf-8"), re.DOTALL)
    assert found
    source = (ENGINES / f"prtbake.{language}").read_text("utf-8")
    text, count = re.subn(rf".*prtbake\.{language}.*\n", lambda _: source, found[1])
    assert count == 1
    return text


def degrees(text: str, scene: Scene) -> str:
    """Set the degrees that an example declares."""
    for name, degree in (("PRT_VIEW_DEGREE", scene.view_degree), ("PRT_LIGHT_DEGREE", scene.light_degree)):
        text, count = re.subn(rf"^((?:#define|const) {name}(?: =)?) \d", rf"\g<1> {degree}", text, count=1, flags=re.M)
        assert count == 1
    return text


def bits(halves: NDArray[np.float16]) -> list[int]:
    found: list[int] = np.ascontiguousarray(halves).view(np.uint16).ravel().tolist()
    return found


def glsl_job(scene: Scene) -> dict[str, Any]:
    """The vertex shader of the README, for WebGL2."""
    height, width, _ = scene.texels.shape
    uniforms = {
        "object_to_world": ("Matrix4fv", scene.object_to_world.T),
        "world_to_clip": ("Matrix4fv", np.eye(4)),
        "eye": ("3fv", scene.eye),
        "sky": ("3fv", scene.sky),
        "sun": ("3fv", scene.sun),
        "irradiance": ("3fv", scene.irradiance),
        "constant": ("3fv", scene.constant),
    }
    return {
        "shader": degrees(example("glsl"), scene),
        "attributes": {
            "position": {"size": 3, "values": scene.positions.ravel().tolist()},
            "texel": {"size": 2, "values": scene.vertices.ravel().tolist()},
        },
        "uniforms": {name: {"kind": kind, "values": np.ravel(v).tolist()} for name, (kind, v) in uniforms.items()},
        "textures": [
            {"name": "prt_texture", "width": width, "height": height, "format": "half", "values": bits(scene.texels)}
        ],
        "output": "radiance",
        "count": COUNT,
    }


def hlsl_job(scene: Scene, folder: Path) -> dict[str, Any]:
    """The vertex shader of the README, compiled to SPIR-V and translated to GLSL ES."""
    (folder / "example.hlsl").write_text(degrees(example("hlsl"), scene), "utf-8")
    compile_hlsl(folder / "example.hlsl", "vert", folder / "example.spv")
    command = [program("spirv-cross", "spirv-cross"), "example.spv", "--es", "--version", "300"]
    shader = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    row = np.zeros((4 + scene.K, 4))  # float3 of a constant buffer, 16 bytes apart
    row[:, :3] = [scene.eye, scene.sun, scene.irradiance, scene.constant, *scene.sky]
    block = [*scene.object_to_world.T.ravel(), *np.eye(4).ravel(), *row.ravel()]
    job = glsl_job(scene)
    job["attributes"] = {
        re.findall(rf"in {kind} (\w+);", shader)[0]: job["attributes"][name]
        for kind, name in (("vec3", "position"), ("vec2", "texel"))
    }
    job["textures"][0]["name"] = re.findall(r"sampler2D (\w+);", shader)[0]
    output = re.findall(r"out vec3 (\w+);", shader)[0]
    return {**job, "shader": shader, "uniforms": {}, "block": [float(x) for x in block], "output": output}


def compile_hlsl(source: Path, stage: str, output: Path) -> None:
    run(program("glslangValidator", "glslang-tools"), "-D", "-V", "-e", "main", "-S", stage, "-o", output, source)
    run(program("spirv-val", "spirv-tools"), output)


def run(*command: object) -> None:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


WGSL_MAIN = """
@group(0) @binding(0) var<storage, read_write> results: array<vec3f>;
@group(0) @binding(2) var<storage, read> scene: array<vec4f>;  // the columns of a matrix; eye, sun, …, b, positions

@compute @workgroup_size(1) fn main(@builtin(global_invocation_id) id: vec3u) {
  let object_to_world = mat3x3f(scene[0].xyz, scene[1].xyz, scene[2].xyz);
  var b: array<vec3f, PRT_K>;
  for (var k = 0; k < PRT_K; k++) { b[k] = scene[8 + k].xyz; }
  prt_add_directional(&b, prt_to_object(object_to_world, scene[5].xyz), scene[6].xyz);
  prt_add_constant(&b, scene[7].xyz);
  let world = object_to_world * scene[8 + u32(PRT_K) + id.x].xyz + scene[3].xyz;
  results[id.x] = prt_radiance(id.x, prt_to_object(object_to_world, scene[4].xyz - world), b);
}
"""

WGSL_TEXTURE = """
@group(0) @binding(1) var coefficients: texture_2d<f32>;
fn prt_fetch(vertex: u32, i: u32) -> vec3f {
  let run = u32(PRT_R * PRT_K);
  let row = textureDimensions(coefficients).x / run;
  return textureLoad(coefficients, vec2u(vertex % row * run + i, vertex / row), 0).rgb;
}
"""


def wgsl_job(scene: Scene, texture: bool) -> dict[str, Any]:
    """The block of the README in a compute shader, or the file with a texture for a storage buffer."""
    head, fetch = example("wgsl").split("@group", 1)
    shader = degrees(head, scene) + (WGSL_TEXTURE.replace("binding(1)", "binding(2)") if texture else "@group" + fetch)
    rows = np.zeros((8 + scene.K + COUNT, 4))
    rows[:4] = scene.object_to_world.T
    rows[4:, :3] = [scene.eye, scene.sun, scene.irradiance, scene.constant, *scene.sky, *scene.positions]
    main = WGSL_MAIN.replace("binding(2)", "binding(1)") if texture else WGSL_MAIN
    height, width, _ = scene.texels.shape
    alpha = np.concatenate([scene.texels, np.ones((height, width, 1), np.float16)], axis=2)
    return {
        "shader": shader + main,
        "buffers": [*([] if texture else [scene.coefficients.ravel().tolist()]), rows.ravel().tolist()],
        "textures": [{"width": width, "height": height, "values": bits(alpha)}] if texture else [],
        "count": COUNT,
    }


def in_browser(run_node: RunNode, folder: Path, jobs: list[dict[str, Any]], *options: str) -> list[NDArray[np.float64]]:
    (folder / "jobs.json").write_text(json.dumps(jobs))
    (folder / "shaders.mjs").write_bytes((HERE / "shaders.mjs").read_bytes())
    (folder / "index.html").write_text('<script type="module" src="shaders.mjs"></script>')
    return [np.array(one).reshape(-1, 3) for one in run_node("browser.mjs", *options, folder, "index.html")]


def compare(found: list[NDArray[np.float64]], scenes: list[Scene] = SCENES) -> None:
    for radiance, scene in zip(found, scenes, strict=True):
        off = np.abs(radiance - scene.radiance).max() / scene.radiance.max()
        assert off < TOLERANCE, scene


@pytest.mark.usefixtures("chromium")
def test_glsl_gives_the_radiance(run_node: RunNode, tmp_path: Path) -> None:
    compare(in_browser(run_node, tmp_path, [glsl_job(scene) for scene in SCENES]))


@pytest.mark.usefixtures("chromium")
def test_a_stretched_node_takes_the_transposed_inverse(run_node: RunNode, tmp_path: Path) -> None:
    scene = Scene(3, 2, stretched=True)
    job = glsl_job(scene)
    shader, count = re.subn(r"(?<=prt_to_object\()mat3\(object_to_world\)", r"transpose(inverse(\g<0>))", job["shader"])
    assert count == 2
    compare(in_browser(run_node, tmp_path, [job | {"shader": shader}]), [scene])


@pytest.mark.usefixtures("chromium")
def test_hlsl_gives_the_radiance(run_node: RunNode, tmp_path: Path) -> None:
    compare(in_browser(run_node, tmp_path, [hlsl_job(scene, tmp_path) for scene in SCENES]))


@pytest.mark.usefixtures("chromium")
@pytest.mark.parametrize("texture", [False, True])
def test_wgsl_gives_the_radiance(texture: bool, run_node: RunNode, tmp_path: Path) -> None:
    compare(in_browser(run_node, tmp_path, [wgsl_job(scene, texture) for scene in SCENES], "--webgpu"))


BUFFER = """
layout(std430, binding = 0) readonly buffer Coefficients { float coefficients[]; };
#define PRT_VERTEX int
vec3 fetch(int at) { return vec3(coefficients[at], coefficients[at + 1], coefficients[at + 2]); }
#define PRT_FETCH(vertex, i) fetch(3 * (vertex * PRT_R * PRT_K + i))
"""


@pytest.mark.parametrize("version", ["300 es", "330", "450"])
def test_glsl_compiles(version: str, tmp_path: Path) -> None:
    (tmp_path / "shader.vert").write_text(example("glsl").replace("300 es", version), "utf-8")
    run(program("glslangValidator", "glslang-tools"), tmp_path / "shader.vert")


def test_glsl_compiles_with_a_buffer(tmp_path: Path) -> None:
    text = example("glsl").replace("#define PRT_LIGHT_DEGREE 2\n", "#define PRT_LIGHT_DEGREE 2\n" + BUFFER, 1)
    text = re.sub(r"ivec2\(texel.*?\), outgoing", "gl_VertexID, outgoing", text).replace("300 es", "450")
    (tmp_path / "shader.vert").write_text(text, "utf-8")
    run(program("glslangValidator", "glslang-tools"), tmp_path / "shader.vert")


def test_hlsl_compiles_with_a_buffer(tmp_path: Path) -> None:
    macros = """
#define PRT_SOURCE StructuredBuffer<float3>
#define PRT_VERTEX uint
#define PRT_FETCH(source, vertex, i) source[vertex * PRT_R * PRT_K + i]
"""
    text = example("hlsl").replace("#define PRT_LIGHT_DEGREE 2\n", "#define PRT_LIGHT_DEGREE 2\n" + macros, 1)
    text = text.replace("Texture2D<float4> coefficients", "StructuredBuffer<float3> coefficients")
    text = text.replace("float2 texel : TEXCOORD1", "uint index : SV_VertexID")
    text = re.sub(r"    int width.*\n.*\n", "", text)
    text = re.sub(r"int2\(texel.*?\)\), outgoing", "index, outgoing", text)
    (tmp_path / "shader.hlsl").write_text(text, "utf-8")
    compile_hlsl(tmp_path / "shader.hlsl", "vert", tmp_path / "shader.spv")


@pytest.mark.parametrize("name", ["prtbake.glsl", "prtbake.wgsl", "prtbake.hlsl"])
def test_files_are_short(name: str) -> None:
    lines = (ENGINES / name).read_text("utf-8").splitlines()
    assert len(lines) <= 60
    assert max(map(len, lines)) <= 120
