"""The group /selftest of an asset: radiance that a reader must reproduce (docs/reference/asset.md, "Self-test")."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

GROUP = "selftest"
DATASETS: dict[str, tuple[str, tuple[str, ...]]] = {
    f"{GROUP}/light": ("f", ("K", "3")),
    f"{GROUP}/vertex": ("iu", ("S",)),
    f"{GROUP}/outgoing": ("f", ("S", "3")),
    f"{GROUP}/radiance": ("f", ("S", "3")),
}
OF_LOBES: dict[str, tuple[str, tuple[str, ...]]] = {
    f"{GROUP}/sun": ("f", ("3",)),
    f"{GROUP}/lobes": ("f", ("S", "3")),
}


def write_selftest(file: Any, selftest: Mapping[str, NDArray[Any]]) -> None:
    """Write the group into an open asset."""
    group = file.create_group(GROUP)
    for name, values in selftest.items():
        group.create_dataset(name, data=np.asarray(values).astype("<u4" if name == "vertex" else "<f8"))
