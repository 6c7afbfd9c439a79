"""`prtbake check` finds faults of assets whose file is readable."""

import dataclasses
import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from formats.asset import write_asset
from formats.asset.total_error import ErrorInterval
from prt_bake.inspection.asset import soundness_faults
from prt_bake.mathematics import sphere
from prt_bake.shading.selftest import selftest_error
from tests.cli.command_line import Run
from tests.shading.test_picture import make_asset
from tests.shapes import ball


@pytest.fixture
def baked(folder: Path, prtbake: Run, tmp_path: Path) -> Path:
    path = tmp_path / "a.h5"
    path.write_bytes((folder / "asset.h5").read_bytes())
    assert prtbake("check", path).out.strip() == f"{path}: sound"
    return path


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda file: _times(file["basis/check_values"], -1.0), "of another basis or damaged"),
        (lambda file: _times(file["transfer/coefficients"], 1.01), "/selftest: its radiance differs"),
        (lambda file: _times(file["selftest/radiance"], 0.99), "/selftest: its radiance differs"),
        (lambda file: file["transfer/valid"].write_direct(np.zeros_like(file["transfer/valid"][...])), "no vertex"),
    ],
)
def test_inconsistent_contents_are_faults(prtbake: Run, baked: Path, change, sentence: str) -> None:
    with h5py.File(baked, "r+") as file:
        change(file)
    outcome = prtbake("check", baked)
    assert outcome.code == 1
    printed = outcome.out + outcome.err
    assert sentence in printed
    assert str(baked) in printed


@pytest.mark.parametrize("command", ["shade", "compress"])
def test_coefficients_in_another_order_are_a_warning(prtbake: Run, baked: Path, tmp_path: Path, command: str) -> None:
    with h5py.File(baked, "r+") as file:
        file["transfer/coefficients"][...] = file["transfer/coefficients"][...][::-1]
    options = {
        "shade": ["--light", "sky.exr", "--size", "16x12", "-o", tmp_path / "a.exr"],
        "compress": ["-o", tmp_path / "c.h5"],
    }
    outcome = prtbake(command, baked, *options[command])
    assert outcome.code == 0
    assert f"prtbake: warning: {baked}: /selftest: its radiance differs" in outcome.err


@pytest.mark.parametrize("part", ["mesh", "positions", "faces", "origin"])
def test_a_changed_mesh_is_a_fault(prtbake: Run, baked: Path, part: str) -> None:
    """The changed vertices are not among those of the self-test."""
    with h5py.File(baked, "r+") as file:
        mesh = file["mesh"]
        first, second = np.setdiff1d(np.arange(len(mesh["positions"])), file["selftest/vertex"][...])[:2]
        if part == "origin":
            mesh["positions"].attrs["origin"] = [1e-6, 0.0, 0.0]
        elif part == "faces":
            mesh["faces"][...] = mesh["faces"][...][::-1]
        for name in ("positions", "normals", "tangents") if part == "mesh" else ("positions",) * (part == "positions"):
            rows = mesh[name][...]
            rows[[first, second]] = rows[[second, first]]
            mesh[name][...] = rows
    outcome = prtbake("check", baked)
    assert outcome.code == 1
    assert "/mesh: is not the mesh that was baked, or its vertices are in another order" in outcome.out


def test_an_asset_without_a_mesh_digest_is_sound(prtbake: Run, baked: Path) -> None:
    with h5py.File(baked, "r+") as file:
        del file["mesh"].attrs["sha256"]
    assert prtbake("check", baked).code == 0


def test_only_a_failed_selftest_is_a_fault() -> None:
    asset = make_asset(ball(2))
    assert list(soundness_faults(asset)) == []
    local = sphere.uniform(5, 3)
    vertices = np.array([0, 3, 9, 20, 41])
    outgoing = sphere.to_world(local, asset.mesh.normals[vertices], asset.tangents[vertices])
    light = np.random.default_rng(1).normal(size=(9, 3))
    selftest = {"light": light, "vertex": vertices, "outgoing": outgoing, "radiance": np.zeros((5, 3))}
    asset = dataclasses.replace(asset, selftest=selftest)
    assert selftest_error(asset) == 1.0
    assert len(list(soundness_faults(asset))) == 1


def _times(dataset: h5py.Dataset, factor: float) -> None:
    dataset[...] = dataset[...] * factor


def test_a_baked_asset_reproduces_its_selftest(baked: Path, tmp_path: Path) -> None:
    from formats.asset import read_asset

    asset = read_asset(baked)
    assert asset.selftest
    assert selftest_error(asset) < 1e-6
    write_asset(asset, tmp_path / "again.h5")
    assert selftest_error(read_asset(tmp_path / "again.h5")) < 1e-6


def test_info_prints_the_error_of_network_and_bake_first(prtbake: Run, tmp_path: Path) -> None:
    provenance = {"estimated_relative_rmse": {"total": 0.01}}
    asset = dataclasses.replace(
        make_asset(ball(1)), network_error=ErrorInterval(0.06, 0.05, 0.08), provenance=provenance
    )
    write_asset(asset, tmp_path / "a.h5")
    lines = prtbake("info", tmp_path / "a.h5", "--all").out.splitlines()
    names, figures = zip(*(line.split("  ", 1) for line in lines), strict=True)
    assert names[:3] == ("kind", "bytes", "error of the coefficients")
    assert figures[2].strip() == "6.08% (5.10% to 8.06%): the network is off by 6.00%, the bake is off by 1.00%"
    stated = json.loads(prtbake("info", tmp_path / "a.h5", "--json").out)["errors"]
    assert stated == asset.error.as_json()
