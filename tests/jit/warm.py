"""Compile the path tracer's kernels once, so that parallel test processes find them in the cache."""

import gc
import tempfile
from pathlib import Path

import numpy as np

from prt_bake.geometry.surface import Surface
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from prt_bake.tracer.light_samples import sample_exits
from tests.tracer.scenes import make_scene, queries, sphere, unit_directions


def main() -> None:
    """Run every kernel on one small scene."""
    with tempfile.TemporaryDirectory() as folder:
        scene = make_scene(Path(folder), sphere(1), eta=1.3, roughness=0.4)
    positions, outgoing, _ = queries(scene.mesh, 2, 1)
    estimate_transport(scene, positions, outgoing, unit_directions(2, 3), 2)
    estimate_coefficients(scene, positions, outgoing, 1, 2)
    location = Surface(scene.mesh).locate(positions, outgoing)
    sample_exits(scene, location.faces, location.barycentric, outgoing, np.arange(2, dtype=np.uint64), 2, 1)


if __name__ == "__main__":
    # The compiler's objects stay alive, so garbage collection only costs time.
    gc.disable()
    main()
