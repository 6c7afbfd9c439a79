"""The C# of `engines/unity` against signatures of Unity, and its arithmetic; the shader without Unity's own include.

Unity itself is not run.
"""

import math
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np

import prt_bake as prt
from formats.mesh import read_mesh
from prt_bake.mathematics import sh
from tests import ROOT
from tests.engines.conftest import HERE, program

UNITY, STUBS = ROOT / "engines/unity", HERE / "unity"


def compiled(folder: Path, *sources: Path, target: str = "exe") -> Path:
    made = folder / f"made.{target}"
    kind = "exe" if target == "exe" else "library"
    command = [program("mcs", "mono-mcs"), "-warnaserror", "-nowarn:0649,0169", f"-target:{kind}", f"-out:{made}"]
    done = subprocess.run([*command, *map(str, sources)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return made


def test_every_script_compiles(tmp_path: Path) -> None:
    scripts = sorted(UNITY.rglob("*.cs"))
    assert len(scripts) == 4
    compiled(tmp_path, *scripts, STUBS / "Stubs.cs", STUBS / "Json.cs", target="dll")


def test_the_mesh_and_the_light(spot: Path, tmp_path: Path) -> None:
    asset = prt.read_asset(spot / "spot.h5")
    prt.export_exr(asset, tmp_path / "x.exr")
    size = re.search(r'"width": (\d+),\s+"height": (\d+)', (tmp_path / "x.json").read_text("utf-8"))
    assert size
    width, height = int(size[1]), int(size[2])
    random = np.random.default_rng(6)
    probe, from_sun, colour, intensity = random.normal(size=(9, 3)), np.array([2, -3, 6]) / 7, (3, 2, 1), 1.5
    numbers = [*probe.ravel(), *from_sun, *colour, intensity]
    (tmp_path / "light.txt").write_text(" ".join(map(str, numbers)))
    made = compiled(tmp_path, *sorted(UNITY.glob("*.cs")), *sorted(STUBS.glob("*.cs")))
    files = [tmp_path / "x.mesh.glb", width, height, tmp_path / "light.txt"]
    command = [program("mono", "mono-runtime"), str(made), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    positions, normals, uv, texels, triangles, ambient, sun = (
        np.array(line.split(), float) for line in done.stdout.splitlines()
    )

    mirror = np.array([1, 1, -1])
    mesh = read_mesh(tmp_path / "x.mesh.glb")
    middle = (mesh.positions.min(axis=0) + mesh.positions.max(axis=0)) / 2
    np.testing.assert_allclose(positions.reshape(-1, 3) * mirror, mesh.positions - middle, atol=1e-6)
    np.testing.assert_allclose(normals.reshape(-1, 3) * mirror, asset.mesh.normals, atol=1e-6)
    assert np.array_equal(triangles.reshape(-1, 3)[:, ::-1], asset.mesh.faces)
    assert asset.mesh.uv is not None
    np.testing.assert_allclose(uv.reshape(-1, 2), asset.mesh.uv, atol=1e-6)
    per_row = width // 144
    row, place = np.divmod(np.arange(len(asset.valid)), per_row)
    assert np.array_equal(texels.reshape(-1, 2), np.stack([144 * place, height - 1 - row], axis=1))

    object_to_world = np.roll(np.diag(mirror), 1, axis=0)
    directions, weights = sh.quadrature(4)
    monomials = prt.sh.evaluate(directions @ object_to_world.T, 2) / norms()
    to_radiance = np.array([1] + [3 / 2] * 3 + [4] * 5)[:, None]
    b = to_radiance * (sh.evaluate(directions, 2).T @ (weights[:, None] * (monomials @ probe)))
    np.testing.assert_allclose(ambient.reshape(9, 3), b, atol=1e-5)
    expected = np.outer(sh.evaluate(from_sun * mirror, 2), np.array(colour) * intensity * math.pi)
    np.testing.assert_allclose(sun.reshape(9, 3), expected, atol=1e-5)


def norms() -> np.ndarray:
    """The constants of the nine harmonics."""
    return np.sqrt(np.array([1 / 4, 3 / 4, 3 / 4, 3 / 4, 15 / 4, 15 / 4, 5 / 16, 15 / 4, 15 / 16]) / math.pi)


def test_the_shader_compiles(tmp_path: Path) -> None:
    text = (UNITY / "Prtbake.shader").read_text("utf-8")
    code = re.search(r"HLSLPROGRAM\n(.*?)ENDHLSL", text, re.DOTALL)
    assert code
    (tmp_path / "shader.hlsl").write_text(code[1], "utf-8")
    shutil.copy(ROOT / "engines/prtbake.hlsl", tmp_path)
    shutil.copy(STUBS / "UnityCG.cginc", tmp_path)
    for stage, entry in (("vert", "vert"), ("frag", "frag")):
        command = [program("glslangValidator", "glslang-tools"), "-D", "-V", "-e", entry, "-S", stage, "shader.hlsl"]
        done = subprocess.run(
            [*command, "-o", f"{stage}.spv"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout


def test_files_are_short() -> None:
    for path in UNITY.rglob("*.*"):
        lines = path.read_text("utf-8").splitlines()
        assert len(lines) <= 60, path
        assert max(map(len, lines)) <= 120, path


def test_the_node_of_unreal_compiles(tmp_path: Path) -> None:
    """As Unreal makes a function of a Custom node: its inputs are the arguments."""
    page = (ROOT / "docs/how_to/unity_unreal.md").read_text("utf-8")
    code = re.search(r"```hlsl\n(.*?)```", page, re.DOTALL)
    assert code
    inputs = "Texture2D Coefficients, float2 Texel, float3 ToEye, float3 ToSun, float3 Irradiance, float3 Sky"
    (tmp_path / "node.hlsl").write_text(
        f"""#define PRT_VIEW_DEGREE 3
#define PRT_LIGHT_DEGREE 2
#include "prtbake.hlsl"
Texture2D texture0;
float3 node({inputs}) {{
{code[1]}}}
float4 main(float2 texel : TEXCOORD1, float3 eye : A, float3 sun : B) : SV_Position {{
    return float4(node(texture0, texel, eye, sun, 1, 1), 1);
}}
""",
        "utf-8",
    )
    shutil.copy(ROOT / "engines/prtbake.hlsl", tmp_path)
    command = [program("glslangValidator", "glslang-tools"), "-D", "-V", "-e", "main", "-S", "vert", "node.hlsl"]
    done = subprocess.run([*command, "-o", "node.spv"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
