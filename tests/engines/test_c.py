"""`engines/prtbake.h` in C and C++: the self-test, the radiance of `prt.shade`, and a sentence for each bad file."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import prt_bake as prt
from prt_bake.mathematics import sh
from tests import ROOT
from tests.baking.output.test_selftest import ASSETS
from tests.engines.conftest import missing, program
from tests.shapes import ball

ENGINES = ROOT / "engines"
COMPILERS = {
    "C": ("gcc", "-std=c99 -pedantic -x c"),
    "C++": ("g++", "-std=c++11 -x c++"),
}
EYES = """
#include "prtbake.h"
int main(int count, char **words) {
    static prt_asset asset;
    static double eye_and_light[3 + 27];
    if (count < 2 || !prt_open(words[1], &asset)) return 1;
    fprintf(stderr, "%.9g\\n", prt_selftest(&asset));
    while (fread(eye_and_light, sizeof eye_and_light, 1, stdin) == 1)
        for (size_t v = 0; v < asset.vertices; v++) {
            double d[3], rgb[3];
            for (int c = 0; c < 3; c++) d[c] = eye_and_light[c] - (asset.positions[3 * v + c] + asset.origin[c]);
            double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
            for (int c = 0; c < 3; c++) d[c] /= length;
            prt_radiance(&asset, v, d, eye_and_light + 3, rgb);
            fwrite(rgb, sizeof rgb, 1, stdout);
        }
    prt_close(&asset);
    return 0;
}
"""
LIGHT = np.random.default_rng(1).normal(size=(9, 3)) + [[3.0, 2.0, 1.0]] * 9


def compiled(source: Path, output: Path, language: str) -> Path:
    """Compile a program as the header says, with all warnings as errors."""
    compiler, options = COMPILERS[language]
    package = [program("pkg-config", "pkg-config"), "--cflags", "--libs", "hdf5"]
    found = subprocess.run(package, capture_output=True, text=True, check=False)
    if found.returncode:
        missing("libhdf5 was not found: install the package libhdf5-dev")
    words = [program(compiler, compiler), *shlex.split(options), "-O2", "-Wall", "-Wextra", "-Werror", f"-I{ENGINES}"]
    done = subprocess.run([*words, source, *shlex.split(found.stdout), "-lm", "-o", output], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    return output


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("c")


@pytest.fixture(scope="module")
def eyes(folder: Path) -> Path:
    """A program that prints the self-test, and the radiance of all vertices for eyes and lights."""
    (folder / "eyes.c").write_text(EYES, encoding="utf-8")
    return compiled(folder / "eyes.c", folder / "eyes", "C")


@pytest.fixture(scope="module")
def example(folder: Path) -> Path:
    return compiled(ENGINES / "example.c", folder / "example", "C")


def check(eyes: Path, path: Path, light: Any = LIGHT) -> None:
    """Compare the self-test, and frames for random eyes, with those of the package."""
    asset = prt.read_asset(path)
    b = np.zeros((9, 3))
    if light is not None:
        b[: len(light)] = light
    views = np.random.default_rng(2).normal(size=(5, 3)) * 3.0 + asset.mesh.center
    rows = np.hstack([views, np.tile(b.ravel(), (5, 1))])
    done = subprocess.run([eyes, path], input=rows.tobytes(), capture_output=True, check=True)
    assert float(done.stderr) < 1e-6
    found = np.frombuffer(done.stdout).reshape(5, -1, 3)
    expected = np.stack([prt.shade(asset, light, eye) for eye in views])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * expected.max())


def test_the_radiance_of_spot_is_that_of_shade(eyes: Path, spot: Path) -> None:
    check(eyes, spot / "spot.h5")


@pytest.mark.parametrize("name", ASSETS)
@pytest.mark.parametrize("storage", ["float16", "float32"])
def test_every_kind_of_asset_is_read(eyes: Path, tmp_path: Path, name: str, storage: str) -> None:
    transport, options, _ = ASSETS[name]
    baked = prt.bake(transport, ball(1), samples=32, lobes=0, out=tmp_path / "a.h5", storage=storage, **options)
    assert baked.storage == storage
    baked.close()
    light = None if "for_light" in options else LIGHT[: sh.count(options.get("degree", 2))]
    check(eyes, tmp_path / "a.h5", light)


def test_the_example_prints_the_radiance_under_its_sun(example: Path, spot: Path) -> None:
    done = subprocess.run([example, spot / "spot.h5", "1", "2", "-3"], capture_output=True, text=True, check=True)
    first, *rows, last = done.stdout.splitlines()
    assert first.startswith("2930 vertices in ")
    assert last.endswith(" ms for all vertices")
    asset = prt.read_asset(spot / "spot.h5")
    light = np.outer(sh.evaluate(np.array([2.0, 3.0, 6.0]) / 7.0, 2), [3.0, 2.5, 2.0])
    expected = prt.shade(asset, light, [1.0, 2.0, -3.0])
    assert len(rows) == 5
    for row in rows:
        vertex, values = row.removeprefix("vertex ").split(": ")
        np.testing.assert_allclose([float(value) for value in values.split()], expected[int(vertex)], rtol=1e-4)


def test_it_compiles_as_cpp(folder: Path) -> None:
    compiled(ENGINES / "example.c", folder / "example_cpp", "C++")


def test_the_page_compiles_and_runs(spot: Path, tmp_path: Path) -> None:
    page = (ROOT / "docs/how_to/own_renderer.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    last = "prt_close(&asset);"
    assert last in block
    block = block.replace(last, f'printf("%.9g %.9g %.9g", rgb[0], rgb[1], rgb[2]);\n{last}')
    source = f'#include "prtbake.h"\nint main(void) {{\n{block}return 0;\n}}\n'
    (tmp_path / "page.c").write_text(source, encoding="utf-8")
    done = subprocess.run(
        [compiled(tmp_path / "page.c", tmp_path / "page", "C")], cwd=spot, capture_output=True, text=True, check=True
    )
    asset = prt.read_asset(spot / "spot.h5")
    views = np.tile([0.0, 0.6, 0.8], (len(asset.valid), 1))
    expected = prt.shade(asset, np.sqrt(4.0 * np.pi) * np.eye(9)[:, :1] * np.ones(3), views)[-1]
    np.testing.assert_allclose([float(value) for value in done.stdout.split()], expected, rtol=1e-6)
    assert done.stderr == ""


def test_a_program_that_uses_a_part_has_no_warnings(tmp_path: Path) -> None:
    (tmp_path / "part.c").write_text('#include "prtbake.h"\nint main(void) { return 0; }\n', encoding="utf-8")
    compiled(tmp_path / "part.c", tmp_path / "part", "C")


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def edited(change: Callable[[Any], None]) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return edit


def damaged(path: Path) -> None:
    """Overwrite the first chunk of the coefficients."""
    with h5py.File(path) as file:
        place = file["transfer/coefficients"].id.get_chunk_info(0).byte_offset
    with open(path, "r+b") as file:
        file.seek(place)
        file.write(bytes(1000))


def replaced(name: str, values: Any) -> Callable[[Path], None]:
    def change(file: Any) -> None:
        del file[name]
        file[name] = values

    return edited(change)


BAD = {
    "missing": (Path.unlink, "is missing, truncated or not HDF5"),
    "truncated": (truncated, "is missing, truncated or not HDF5"),
    "a text": (lambda path: path.write_text("solid\n"), "is missing, truncated or not HDF5"),
    "another HDF5 file": (edited(lambda file: file.attrs.clear()), "is not an asset of prtbake"),
    "version 2": (edited(lambda file: file.attrs.update(format_version="2.0")), "has another format_version than 1.x"),
    "no degree": (edited(lambda file: file["basis"].attrs.clear()), "lacks its rings, sectors, degree or origin"),
    "rings of another shape": (
        edited(lambda file: file["bins"].attrs.update(rings=np.arange(4000))),
        "lacks its rings, sectors, degree or origin",
    ),
    "other bins": (edited(lambda file: file["bins"].attrs.update(rings=7)), "has no /transfer/coefficients [V, B or 1"),
    "no coefficients": (
        edited(lambda file: file["transfer"].pop("coefficients")),
        "has no /transfer/coefficients [V, B or 1",
    ),
    "damaged": (damaged, "/transfer/coefficients is missing, damaged or of another size"),
    "fewer normals": (
        replaced("mesh/normals", np.zeros((3, 3))),
        "/mesh/normals is missing, damaged or of another size",
    ),
    "a single normal": (replaced("mesh/normals", 1.0), "/mesh/normals is missing, damaged or of another size"),
    "no faces": (edited(lambda file: file["mesh"].pop("faces")), "/mesh/faces is missing, damaged or of another size"),
    "faces too high": (replaced("mesh/faces", np.full((2, 3), 18)), "has faces of vertices that it lacks"),
    "rows too high": (replaced("selftest/vertex", np.full(33, 18)), "has a self-test of vertices that it lacks"),
    "rows of another length": (replaced("selftest/outgoing", np.ones((2, 3))), "/selftest/outgoing is missing"),
}


@pytest.fixture(scope="module")
def small(folder: Path) -> bytes:
    transport, options, _ = ASSETS["4 × 8 bins"]
    prt.bake(transport, ball(1), samples=32, lobes=0, out=folder / "small.h5", **options).close()
    return (folder / "small.h5").read_bytes()


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_gives_one_sentence(example: Path, small: bytes, tmp_path: Path, name: str) -> None:
    change, sentence = BAD[name]
    (tmp_path / "a.h5").write_bytes(small)
    change(tmp_path / "a.h5")
    done = subprocess.run([example, tmp_path / "a.h5"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith(f"{tmp_path}/a.h5 ")
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_compact_asset_is_refused(example: Path, small: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(small)
    prt.write_asset(prt.compress(prt.read_asset(tmp_path / "a.h5"), 0.05), tmp_path / "compact.h5")
    done = subprocess.run([example, tmp_path / "compact.h5"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    sentence, code = done.stderr.strip().split('python3 -c "')
    assert sentence == f"{tmp_path}/compact.h5 is compact; unpack it: "
    code = code.removesuffix('"').replace("COMPACT.h5", "compact.h5")
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
    subprocess.run([example, tmp_path / "PLAIN.h5"], capture_output=True, check=True)


def test_an_asset_without_a_self_test_has_no_result(eyes: Path, small: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(small)
    edited(lambda file: file["selftest"].clear())(tmp_path / "a.h5")
    done = subprocess.run([eyes, tmp_path / "a.h5"], input="", capture_output=True, text=True, check=True)
    assert "nan" in done.stderr


def test_changed_coefficients_fail_the_self_test(eyes: Path, small: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(small)
    edited(lambda file: file["transfer/coefficients"].write_direct(1.01 * file["transfer/coefficients"][...]))(
        tmp_path / "a.h5"
    )
    done = subprocess.run([eyes, tmp_path / "a.h5"], input="", capture_output=True, text=True, check=True)
    assert float(done.stderr) > 1e-3
