"""The group /lobes of an asset file: every fault of it is named."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import prt_bake as prt
from formats.asset import check_asset
from formats.asset.lobes import Lobes, add_lobes_to_file
from formats.errors import AssetError
from tests.baking.lobes.transports import MESH, Smooth

V, N, J = len(MESH.positions), 4, 2


def lobes(**changed: Any) -> Lobes:
    axes = np.zeros((V, N, J, 3), np.float32)
    axes[..., 1] = 1.0
    parts: dict[str, Any] = {
        "rings": 2,
        "sectors": 2,
        "axes": axes,
        "sharpness": np.full((V, N, J), 9.0, np.float32),
        "powers": np.ones((V, N, J, 3), np.float32),
    }
    return Lobes(**parts | changed)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lobes") / "bare.h5"
    prt.bake(Smooth(), MESH, rings=2, sectors=4, out=path).close()
    return path


def replace_dataset(name: str, values: Any) -> Callable[[Any], None]:
    def change(group: Any) -> None:
        del group[name]
        group[name] = values

    return change


def set_attribute(name: str, value: Any) -> Callable[[Any], None]:
    return lambda group: group.attrs.__setitem__(name, value)


FAULTS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "no axes": (lambda group: group.pop("axes"), "/lobes/axes is missing"),
    "a group in place of powers": (
        lambda group: (group.pop("powers"), group.create_group("powers")),
        "/lobes/powers is missing",
    ),
    "no rings": (lambda group: group.attrs.pop("rings"), "the attribute rings is 'missing'"),
    "half a ring": (set_attribute("rings", 0.5), "expected an integer from 1 to 8"),
    "a list": (set_attribute("sectors", [2, 2]), "expected an integer from 1 to 8"),
    "a text": (set_attribute("sectors", "many"), "expected an integer from 1 to 8"),
    "too many nodes": (set_attribute("rings", 8), "has 16 nodes; expected at most as many as view bins, 8"),
    "other nodes": (set_attribute("rings", 1), "expected floats of shape"),
    "too many lobes": (replace_dataset("sharpness", np.ones((V, N, 17))), "has 17 lobes in a view; expected 1 to 16"),
    "no lobe": (replace_dataset("sharpness", np.ones((V, N, 0))), "has 0 lobes in a view"),
    "integers": (replace_dataset("powers", np.ones((V, N, J, 3), int)), "/lobes/powers is int64"),
    "one axis": (replace_dataset("axes", np.ones((V, 3))), "expected floats of shape [18, 4, 2, 3]"),
    "long axes": (
        replace_dataset("axes", np.ones((V, N, J, 3))),
        "/lobes/axes: not of length about 1 at 18 of 18 vertices",
    ),
    "no width": (replace_dataset("sharpness", np.zeros((V, N, J))), "not finite and greater than 0"),
    "infinite": (replace_dataset("powers", np.full((V, N, J, 3), np.inf)), "/lobes/powers: not finite at 18 of 18"),
    "not a number": (replace_dataset("axes", np.full((V, N, J, 3), np.nan)), "/lobes/axes: not of length about 1"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_named(bare: Path, tmp_path: Path, fault: str) -> None:
    change, sentence = FAULTS[fault]
    path = tmp_path / "lobed.h5"
    add_lobes_to_file(bare, path, lobes(), {}, {})
    assert check_asset(path) == []
    with h5py.File(path, "r+") as file:
        change(file["lobes"])
    assert any(sentence in found for found in check_asset(path))
    with pytest.raises(AssetError):
        prt.read_asset(path)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_powers_of_every_size_are_stored(bare: Path, tmp_path: Path, size: float) -> None:
    powers = size * np.random.default_rng(0).normal(size=(V, N, J, 3)).astype(np.float32)
    add_lobes_to_file(bare, path := tmp_path / "lobed.h5", lobes(powers=powers), {}, {})
    stored = prt.read_asset(path).lobes
    assert stored is not None
    np.testing.assert_allclose(stored.powers, powers, rtol=1e-3, atol=1e-4 * size)


def test_lobes_are_replaced_and_removed(bare: Path, tmp_path: Path) -> None:
    path, before = tmp_path / "lobed.h5", prt.read_asset(bare)
    add_lobes_to_file(bare, path, lobes(), {"lobes": "first"}, {})
    add_lobes_to_file(path, path, lobes(sharpness=np.full((V, N, J), 20.0, np.float32)), {"lobes": "second"}, {})
    second = prt.read_asset(path)
    assert second.lobes is not None
    assert (second.lobes.sharpness == 20.0).all()
    assert second.provenance == before.provenance | {"lobes": "second"}
    add_lobes_to_file(path, path, None, {}, {})
    removed = prt.read_asset(path)
    assert removed.lobes is None
    assert removed.selftest == {}
    with h5py.File(path) as file:
        assert file.attrs["format_version"] == "1.0"


def test_a_file_without_its_lobes_is_as_small_as_before(bare: Path, tmp_path: Path) -> None:
    many = lobes(axes=np.random.default_rng(0).normal(size=(V, N, J, 3)).astype(np.float32))
    paths = [tmp_path / f"{number}.h5" for number in range(3)]
    for source, path, added in zip([bare, *paths], paths, [None, many, None], strict=False):
        add_lobes_to_file(source, path, added, {}, {})
    sizes = [path.stat().st_size for path in paths]
    assert sizes[2] == sizes[0] < sizes[1]
