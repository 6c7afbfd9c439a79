"""Transports that are black, constant or enormous: the errors stated are true, or the transport is refused."""

from pathlib import Path

import numpy as np
import pytest

from formats.asset import read_asset
from formats.errors import QueryError
from prt_bake import bake, compress
from tests.bakers.transports import Array, icosphere


class Constant:
    """Ŝ of one value everywhere."""

    def __init__(self, value: float) -> None:
        self.value = value

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        return np.full((len(positions), incident.shape[-2], 3), self.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("error", [None, 0.02])
def test_a_black_transport_has_no_error(tmp_path: Path, error: float | None) -> None:
    bake(Constant(0.0), icosphere(0), 1, 4, 8, error=error, out=tmp_path / "black.h5")
    asset = read_asset(tmp_path / "black.h5")
    assert not asset.coefficients[:].any()
    assert not asset.standard_error[:].any()
    assert asset.provenance["estimated_relative_rmse"] == {"total": 0.0, "percentile_95_over_vertices": 0.0}


@pytest.mark.parametrize("value", [0.7, 1e-30, 1e30])
@pytest.mark.parametrize("error", [None, 0.02])
def test_the_error_of_a_constant_transport_includes_rounding(value: float, error: float | None) -> None:
    asset = bake(Constant(value), icosphere(0), 1, 4, 8, error=error)
    exact = np.zeros(asset.coefficients.shape)
    exact[:, :, 0] = np.sqrt(4.0 * np.pi) * value
    size = np.sqrt((exact**2).mean(axis=(2, 3)))
    true = np.sqrt(((asset.coefficients - exact) ** 2).mean(axis=(2, 3)))
    assert (true <= 3.0 * asset.standard_error).all()
    assert (asset.standard_error < 1e-6 * size).all()


@pytest.mark.parametrize("error", [1e-6, 0.005, 0.99])
def test_enormous_coefficients_are_not_compressed(error: float) -> None:
    asset = bake(Constant(1e14), icosphere(0), 1, 1, 4)
    assert compress(asset, error).coefficients.added.total <= error
    asset = bake(Constant(1e18), icosphere(0), 1, 1, 4)
    with pytest.raises(QueryError, match=r"expected coefficients within ±1e\+15.* found 3\.545e\+18 at vertex 0"):
        compress(asset, error)
