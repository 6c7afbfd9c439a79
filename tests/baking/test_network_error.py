"""A bake writes the error that the trainer measured into the asset's header."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.asset import read_asset
from formats.asset.total_error import ErrorInterval
from prt_bake.baking.bake import bake
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF
from tests.bakers.transports import Lobed, icosphere

SMALL = NetworkSettings(features=8, width=16, feature_mean=0.0, feature_spread=0.25)
FEW: dict[str, Any] = {"rings": 1, "sectors": 2, "samples": 18}


@pytest.mark.parametrize(
    ("figures", "expected"),
    [
        ({"coefficients": 0.06, "coefficients_interval": [0.05, 0.08]}, ErrorInterval(0.06, 0.05, 0.08)),
        ({"coefficients": 0.06, "coefficients_interval": None}, ErrorInterval(0.06)),
        ({"coefficients": 0.06}, ErrorInterval(0.06)),
        ({"coefficients": None, "coefficients_interval": None}, None),
    ],
)
def test_a_bake_of_a_network_knows_the_networks_error(
    tmp_path: Path, figures: dict[str, Any], expected: ErrorInterval | None
) -> None:
    metadata = {"training": {"relative_rmse": figures}}
    network = NeuralBSSRDF(SMALL, (-1.0, -1.0, -1.0), 2.0, metadata=metadata)
    bake(network, icosphere(0), **FEW, out=tmp_path / "a.h5").close()
    asset = read_asset(tmp_path / "a.h5")
    assert (asset.network_error is None) == (expected is None)
    if expected is not None:
        np.testing.assert_array_equal(asset.network_error, expected)
    assert asset.error.bake == asset.provenance["estimated_relative_rmse"]["total"]


@pytest.mark.parametrize("transport", [NeuralBSSRDF(SMALL, (-1.0, -1.0, -1.0), 2.0), Lobed()])
def test_the_error_of_an_unmeasured_transport_is_unknown(transport: Any) -> None:
    error = bake(transport, icosphere(0), **FEW).error
    assert error.network is None
    assert error.total is None
    assert str(error).startswith("unknown: the network's error is unknown, the bake is off by ")
