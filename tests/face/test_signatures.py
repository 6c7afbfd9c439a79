"""What a tooltip shows: short signatures, and records of one screen."""

import inspect
import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from formats.summary import short
from tests.shading.test_picture import constant, front, make_asset
from tests.shapes import ball

PUBLIC = [(name, getattr(prt, name)) for name in prt.__all__]
FUNCTIONS = [(name, value) for name, value in PUBLIC if callable(value) and not name.endswith(("Error", "Warning"))] + [
    (f"{module}.{name}", value)
    for module in ("sh", "sphere")
    for name, value in vars(getattr(prt, module)).items()
    if inspect.isfunction(value) and not name.startswith("_")
]


@pytest.mark.parametrize(("name", "value"), FUNCTIONS, ids=[name for name, _value in FUNCTIONS])
def test_a_signature_is_short(name: str, value: Any) -> None:
    assert len(str(inspect.signature(value))) < (600 if isinstance(value, type) else 400)
    assert isinstance(value, type) or value.__doc__


def test_a_function_keeps_its_name_defaults_and_pickle() -> None:
    assert str(inspect.signature(prt.shade)) == "(asset, light, eye, *, suns=())"
    assert inspect.signature(prt.bake).parameters["rings"].default == 16
    for name, value in PUBLIC:
        if inspect.isfunction(value):
            assert value.__name__ == name
            assert pickle.loads(pickle.dumps(value)) is value


def records() -> list[Any]:
    mesh = ball(3)
    asset = make_asset(mesh)
    lighting = prt.read_lighting("sun:0,1,0")
    made = [mesh, asset, prt.render_picture(asset, constant(), front()), prt.light_for(asset, lighting), lighting]
    return [*made, prt.suns_apart(lighting, 2), prt.Frames(asset), prt.compress(asset, 0.1), prt.fit_camera(mesh, 8, 8)]


def test_a_record_is_one_screen() -> None:
    for record in records():
        text = repr(record)
        assert len(text) < 1500
        assert max(map(len, text.splitlines())) <= 160
        assert type(record).__name__ in text
    assert f"positions: float64 [{len(ball(3).positions)}, 3], -1 to 1" in repr(ball(3))
    assert "error unknown" in repr(prt.NeuralBSSRDF())


def test_the_record_of_a_closed_file_says_so(tmp_path: Path) -> None:
    prt.write_asset(make_asset(ball(3)), tmp_path / "a.h5")
    asset = prt.read_asset(tmp_path / "a.h5", load=False)
    asset.close()
    assert "coefficients: of a closed file" in repr(asset)


def test_values_are_distinct() -> None:
    values = {
        "[1, 2.5]": np.array([1.0, 2.5]),
        "float64 [2, 2], 0 to 1, 2 not finite": np.array([[0.0, np.nan], [1.0, np.inf]]),
        "float64 [7], none finite": np.full(7, np.nan),
        "bool [8], 2 true": np.arange(8) < 2,
        "float64 [0, 3]": np.zeros((0, 3)),
        "0.333333": 1.0 / 3.0,
        "2 entries: a, b": {"a": 1, "b": 2},
        "(1, 2)": (1, 2),
    }
    assert {short(value): None for value in values.values()} == dict.fromkeys(values)
    assert short([ModuleType("a"), ball(1)]) == "2 Mesh and module"
    assert short("x" * 200).endswith("…")


def test_srgb_is_for_display() -> None:
    np.testing.assert_array_equal(prt.srgb([[0.0, 0.0031308, 2.0]]), [[0, 10, 255]])
    assert prt.srgb(constant()).dtype == np.uint8
