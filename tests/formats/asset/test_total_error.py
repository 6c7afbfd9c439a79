"""The error of an asset: in the header of every form of file, and as one figure of network and bake."""

import dataclasses
import math
from pathlib import Path

import h5py
import numpy as np
import pytest

from formats.asset import Asset, read_asset, write_asset
from formats.asset.total_error import ErrorInterval, TotalError
from prt_bake.baking.compress import compress, unpacked
from tests.baking.test_compress import asset_with, of_rank
from tests.formats.asset.test_asset import make_asset

NETWORK = ErrorInterval(0.06, 0.05, 0.08)
BAKED = {"estimated_relative_rmse": {"total": 0.01, "percentile_95_over_vertices": 0.02}}


@pytest.mark.parametrize("error", [NETWORK, ErrorInterval(0.06), None])
def test_the_header_has_the_networks_error(tmp_path: Path, error: ErrorInterval | None) -> None:
    write_asset(make_asset(network_error=error), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        stored = file.attrs.get("network_error")
    again = read_asset(tmp_path / "a.h5").network_error
    if error is None:
        assert stored is None
        assert again is None
        return
    assert stored.dtype == np.dtype("<f8")
    np.testing.assert_array_equal(stored, error)
    assert isinstance(again, ErrorInterval)
    np.testing.assert_array_equal(again, error)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (TotalError(NETWORK, 0.01), "6.08% (5.10% to 8.06%): the network is off by 6.00%, the bake is off by 1.00%"),
        (
            TotalError(ErrorInterval(0.06), 0.01),
            "6.08% (interval unknown): the network is off by 6.00%, the bake is off by 1.00%",
        ),
        (TotalError(None, 0.01), "unknown: the network's error is unknown, the bake is off by 1.00%"),
        (TotalError(NETWORK, None), "unknown: the network is off by 6.00%, the bake's error is unknown"),
        (TotalError(None, 0.01, True), "1.00%: path traced, without a network, the bake is off by 1.00%"),
        (TotalError(None, None, True), "unknown: path traced, without a network, the bake's error is unknown"),
    ],
)
def test_one_line_has_both_errors_and_their_sum_first(error: TotalError, line: str) -> None:
    assert str(error) == line


def test_the_sum_is_of_squares() -> None:
    total = TotalError(NETWORK, 0.01).total
    assert total == pytest.approx([math.hypot(part, 0.01) for part in NETWORK])
    assert TotalError(NETWORK, 0.01).as_json() == {"total": list(total or ()), "network": [*NETWORK], "bake": 0.01}
    assert TotalError(ErrorInterval(0.0), 0.5).as_json()["total"] == [0.5, None, None]
    assert TotalError(None, 0.01).total is None
    assert TotalError(None, 0.01, path_traced=True).total == pytest.approx(ErrorInterval(0.01), nan_ok=True)


def test_the_bakes_error_is_that_of_its_provenance() -> None:
    assert make_asset().error == TotalError(None, None)
    assert make_asset(provenance=BAKED, network_error=NETWORK).error == TotalError(NETWORK, 0.01)
    assert make_asset(provenance={**BAKED, "walks": {}}).error.path_traced


def test_compression_adds_to_the_bakes_error(tmp_path: Path) -> None:
    """Compact, written and read, unpacked, and compact files of before, whose provenance does not state it."""
    asset = asset_with(of_rank(4, 0.1), provenance=BAKED, network_error=NETWORK)
    compact = compress(asset, 0.05)
    expected = math.hypot(0.01, compact.coefficients.added.total)
    assert expected > 0.02
    write_asset(compact, tmp_path / "compact.h5")
    older = dataclasses.replace(compact, provenance=BAKED)
    forms: list[Asset] = [compact, read_asset(tmp_path / "compact.h5"), unpacked(compact), older]
    for form in forms:
        assert form.error.bake == pytest.approx(expected, rel=1e-6)
        assert form.error.network == NETWORK
