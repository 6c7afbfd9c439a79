"""A bake whose view bins lie below the horizon of the faces says so."""

from dataclasses import replace

import numpy as np
import pytest

from formats.errors import InputWarning
from formats.mesh import read_mesh
from prt_bake.baking.job.views import warn_of_clamped_views
from prt_bake.shipped.demonstration import SHIPPED


def test_clamped_views_are_warned_about() -> None:
    mesh = read_mesh(SHIPPED / "spot.obj")
    warn_of_clamped_views(mesh, 4, 16)
    tilted = mesh.normals + 0.8 * np.roll(mesh.normals, 1, axis=1)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    with pytest.warns(
        InputWarning, match="% of the view bins lie below the horizon .*: the vertex normals do not match"
    ):
        warn_of_clamped_views(replace(mesh, normals=tilted), 4, 16)
