"""The table of conventions in `engines/README.md`: its factors turn what each engine holds into `b`.

The light is a few coloured suns. Engines that project are given their own basis, as their sources have it. Engines that
hold a polynomial get the one that fits irradiance / π, which is integrated here over the hemisphere of each normal
without any harmonics, from the part of the light up to degree 2.
"""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import prt_bake as prt
from tests import ROOT
from tests.engines.conftest import RunNode

Array = NDArray[np.float64]

README = (ROOT / "engines/README.md").read_text("utf-8")
SUNS: Array = np.array([[2.0, 3.0, 6.0], [-6.0, 2.0, 3.0], [3.0, -6.0, -2.0], [-2.0, 6.0, -3.0]]) / 7
COLOURS: Array = np.array([[3.0, 2.0, 1.0], [0.5, 1.0, 2.0], [0.2, 0.1, 0.7], [1.0, 0.3, 0.1]])
B: Array = prt.sh.evaluate(SUNS, 2).T @ COLOURS  # [9,3]


def monomials(directions: Array) -> Array:
    """The polynomials of the harmonics without constants [n,9]."""
    x, y, z = directions.T
    return np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], axis=1)


def babylon() -> Array:
    """SphericalHarmonics.addLight: its constants with the signs that it gives them."""
    squares = np.array([1 / 4, 3 / 4, 3 / 4, 3 / 4, 15 / 4, 15 / 4, 5 / 16, 15 / 4, 15 / 16])
    constants = np.sqrt(squares / math.pi) * [1, -1, 1, -1, 1, -1, 1, -1, 1]
    return (monomials(SUNS) * constants).T @ COLOURS


def unreal() -> Array:
    """SHBasisFunction3, for each sun."""
    constants = [0.282095, -0.488603, 0.488603, -0.488603, 1.092548, -1.092548, 0.315392, -1.092548, 0.546274]
    return (monomials(SUNS) * constants).T @ COLOURS


def cmgen() -> Array:
    """CubemapSH::computeSH: Legendre functions by recursion, then cos mφ, sin mφ, then K_ml."""
    x, y, z = SUNS.T
    basis = np.zeros((9, len(SUNS)))
    p: dict[tuple[int, int], Array] = {(0, 0): np.ones_like(z)}
    for m in range(3):
        if m > 0:
            p[m, m] = (1.0 - 2 * m) * p[m - 1, m - 1]
        for l in range(m + 1, 3):
            p[l, m] = ((2 * l - 1) * z * p[l - 1, m] - (l + m - 1) * p.get((l - 2, m), np.zeros_like(z))) / (l - m)
    cosine, sine = np.ones_like(x), np.zeros_like(x)
    for m in range(3):
        if m > 0:
            cosine, sine = cosine * x - sine * y, sine * x + cosine * y
        for l in range(m, 3):
            k = math.sqrt((2 * l + 1) * math.factorial(l - m) / math.factorial(l + m) / (4 * math.pi))
            k *= math.sqrt(2) if m else 1
            basis[l * (l + 1) - m] = k * sine * p[l, m]
            basis[l * (l + 1) + m] = k * cosine * p[l, m]
    return basis @ COLOURS


def cmgen_shader() -> Array:
    """CubemapSH::computeIrradianceSH3Bands: its table A, and the sums without constants."""
    cosine = np.array([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5)
    a = cosine * np.array([4, 12, 12, 12, 60, 60, 5, 60, 15]) / 16 / math.pi**2
    return (monomials(SUNS) * a).T @ COLOURS


def filament_radiance(directions: Array) -> Array:
    """The constants by which Builder::radiance multiplies, and the shader's sum."""
    constants = [0.282095, -0.325735, 0.325735, -0.325735, 0.273137, -0.273137, 0.078848, -0.273137, 0.136569]
    return monomials(directions) * constants


def play_canvas(directions: Array) -> Array:
    """The sum of `ambient.js`."""
    x, y, z = directions.T
    return np.stack([np.ones_like(x), x, y, z, x * z, z * y, y * x, 3.0 * z * z - 1.0, x * x - y * y], axis=1)


def play_canvas_projection() -> Array:
    """`shFromCubemap`: its weights; each channel adds to the sum of weights that it divides by."""
    weights = np.array([4, 8, 8, 8, 15, 15, 15, 5 / 4, 15 / 4]) / 17
    return (play_canvas(SUNS) * weights).T @ COLOURS * 4 * math.pi / (3 * 4 * math.pi)


def fitted(shader: Callable[[Array], Array]) -> Array:
    """The coefficients with which a shader gives irradiance / π at every normal."""
    normals, _ = prt.sh.quadrature(4)
    irradiance = np.stack([hemisphere(normal) for normal in normals])
    found, residual, rank, _ = np.linalg.lstsq(shader(normals), irradiance / math.pi)
    assert rank == 9
    assert residual.max() < 1e-20
    return found


def hemisphere(normal: Array) -> Array:
    """∫ max(0, n·ω) L(ω) dω [3] of the light up to degree 2, by Gauss nodes in n·ω and equal steps around n."""
    cosine, weights = np.polynomial.legendre.leggauss(8)
    cosine, weights = (cosine + 1) / 2, weights / 2
    phi = 2 * math.pi * np.arange(8) / 8
    tangent = np.cross(normal, [0.6, 0.0, 0.8])
    tangent /= np.linalg.norm(tangent)
    around = np.outer(np.cos(phi), tangent) + np.outer(np.sin(phi), np.cross(normal, tangent))
    directions = cosine[:, None, None] * normal + np.sqrt(1 - cosine[:, None, None] ** 2) * around
    radiance = prt.sh.evaluate(directions, 2) @ B
    total: Array = np.einsum("i,ijc->c", weights * cosine, radiance) * 2 * math.pi / 8
    return total


def splats() -> Array:
    """Coefficients with which the renderer of splats shows the radiance Σ_r A_r Y_r(ωo), here with A = B."""
    to_eye, _ = prt.sh.quadrature(4)
    constants = np.array(
        [28209479, -48860251, 48860251, -48860251, 109254843, -109254843, 31539157, -109254843, 54627422]
    )
    basis = monomials(-to_eye) * constants / 1e8
    return np.asarray(np.linalg.lstsq(basis, prt.sh.evaluate(to_eye, 2) @ B)[0])


HELD: dict[str, Callable[[], Array]] = {
    "Babylon.js": babylon,
    "Unreal": unreal,
    "Unity": lambda: fitted(monomials),
    "PlayCanvas": lambda: fitted(play_canvas),
    "Filament `IndirectLight": lambda: fitted(filament_radiance),
    "Filament `…": lambda: fitted(monomials),
    "Cesium": lambda: fitted(monomials),
    "`cmgen": cmgen,
    "Gaussian": splats,
}
"""What each engine holds for the light [9,3], in its own order, by how its row of the table begins."""


def factors(begins: str) -> tuple[Array, list[int]]:
    """The factors of a row and the index k that each coefficient becomes."""
    (row,) = [line for line in README.splitlines() if line.startswith(f"| {begins}")]
    _, _, numbers, order, *_ = row.split("|")
    found = [float(number.replace("−", "-")) for number in numbers.split(",")]
    assert len(found) == 9
    return np.array(found), [int(k) for k in order.split()]


def to_b(begins: str, held: Array) -> Array:
    numbers, order = factors(begins)
    b = np.full((9, 3), np.nan)
    b[order] = numbers[:, None] * held
    return b


@pytest.mark.parametrize("begins", HELD)
def test_factors_give_b(begins: str) -> None:
    np.testing.assert_allclose(to_b(begins, HELD[begins]()), B, atol=2e-6 * np.abs(B).max())  # engines round to 1e-6


def test_every_row_is_tested() -> None:
    table = README[README.index("| held by") :].split("\n\n")[0].splitlines()[2:]
    assert len(table) == len(HELD) + 1  # three.js
    assert all(sum(line.startswith(f"| {begins}") for line in table) == 1 for begins in HELD)


def test_the_signs_are_needed() -> None:
    """The light tells every factor from its negative, and every k from another."""
    assert (np.abs(B) > 0.05 * np.abs(B).max()).any(axis=1).all()
    assert len(np.unique(np.abs(B).round(3), axis=0)) == 9


def test_cmgen_has_two_forms() -> None:
    np.testing.assert_allclose(cmgen_shader(), fitted(monomials), atol=1e-12)


def test_the_projection_of_play_canvas_is_low() -> None:
    np.testing.assert_allclose(to_b("PlayCanvas", play_canvas_projection()) * 51 / (16 * math.pi), B, rtol=2e-6)


def test_three_gives_b(run_node: RunNode, tmp_path: Path) -> None:
    (tmp_path / "lights.json").write_text(
        json.dumps([[*pair] for pair in zip(SUNS.tolist(), COLOURS.tolist(), strict=True)])
    )
    held = np.array(run_node("three_light.mjs", tmp_path / "lights.json"))
    np.testing.assert_allclose(to_b("three.js", held), B, atol=2e-6 * np.abs(B).max())


def turned() -> Callable[[Callable[[Array], Array], Array], Array]:
    """The function of the README."""
    found = re.search(r"```python\n(.*?def turned.*?)```", README, re.DOTALL)
    assert found
    names: dict[str, Any] = {"basis": lambda directions: prt.sh.evaluate(directions, 2)}
    exec(found[1], names)
    return names["turned"]


@pytest.mark.parametrize("mirror", [[1, 1, 1], [-1, 1, 1]])
def test_a_turned_light(mirror: list[int]) -> None:
    to_light = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0] * mirror
    b = turned()(lambda directions: prt.sh.evaluate(directions, 2) @ B, to_light)
    np.testing.assert_allclose(b, prt.sh.evaluate(SUNS @ to_light, 2).T @ COLOURS, atol=1e-12)


def test_a_turned_ambient_light_of_unity() -> None:
    held, to_light = fitted(monomials), np.eye(3)[[0, 2, 1]]
    b = turned()(lambda directions: monomials(directions) @ held, to_light)
    b *= np.array([1] + [3 / 2] * 3 + [4] * 5)[:, None]
    np.testing.assert_allclose(b, prt.sh.evaluate(SUNS @ to_light, 2).T @ COLOURS, atol=1e-12)
