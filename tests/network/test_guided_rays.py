"""View rays that glass guides: what stands at the far end of a rod is seen through all its total reflections."""

import numpy as np
import pytest
import torch
import trimesh

from prt_bake.network.bssrdf import PRESETS
from prt_bake.network.features.view_path import Body, ViewPath

THICKNESS, DARK_FROM = 0.02, 0.9


def rod_with_a_dark_end() -> list[Body]:
    """A rod of glass along x from 0 to 1, with a body in it, matched in index, that is opaque from DARK_FROM on."""
    rim = 1e-3 * THICKNESS
    whole = trimesh.creation.box(bounds=np.array([[0.0, 0.0, 0.0], [1.0, THICKNESS, THICKNESS]]))
    end = trimesh.creation.box(bounds=whole.bounds + np.array([[DARK_FROM, rim, rim], [-rim] * 3]))
    return [
        Body(np.asarray(whole.vertices), np.asarray(whole.faces), eta=1.5),
        Body(np.asarray(end.vertices), np.asarray(end.faces), parent=0, eta=1.5, attenuation=1e4),
    ]


@pytest.mark.parametrize("degrees", [20.0, 45.0, 70.0])
def test_a_guided_ray_reaches_the_end_of_a_rod(degrees: float) -> None:
    inside = np.arcsin(np.sin(np.radians(degrees)) / 1.5)
    reflections = int(DARK_FROM * np.tan(inside) / THICKNESS)
    towards = torch.tensor([[np.cos(inside), np.sin(inside), 0.0]])
    start = torch.tensor([[0.0, 0.4 * THICKNESS, 0.5 * THICKNESS]], dtype=torch.float64)

    def opacity(most: int) -> float:
        return float(ViewPath(rod_with_a_dark_end(), 4, most)(start, -towards).opacity[0])

    assert opacity(PRESETS["measured"].interfaces) > 0.999
    assert opacity(reflections - 2) == 0.0
