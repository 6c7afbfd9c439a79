"""Light that has crossed an object straight, as a share of all that leaves it, by the object's thickness.

    python -m tests.bench.straight_light [--queries 1500]

The thickness is the longest side in transport mean free paths. The object scatters all light, its index is 1.4 and its
surface smooth, and the sky is uniform. Points and views are those of pixels that look from everywhere. `unscattered`
has not met any particle. `forward` is the mean cosine between the light and the view ray outside the object.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

import prt_bake as prt
from tests.tracer.scenes import make_scene, queries, sphere

THICKNESS = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0)
PATHS = 32


def shares(mesh: prt.Mesh, thickness: float, phase_g: float, count: int) -> tuple[float, float]:
    """The unscattered share, and the mean cosine."""
    reduced = thickness / float(np.ptp(mesh.bounds, axis=0).max())
    with tempfile.TemporaryDirectory() as folder:
        medium = {"sigma_t": reduced / (1.0 - phase_g), "albedo": 1.0, "phase_g": phase_g}
        scene = make_scene(Path(folder), mesh, eta=1.4, **medium)
    positions, outgoing, normals = queries(scene.mesh, count, 1)
    seen = np.sum(outgoing * normals, axis=1)
    estimate = prt.estimate_coefficients(scene, positions, outgoing, degree=1, paths=PATHS)
    band_0, band_1 = estimate.mean[:, 0, 0], estimate.mean[:, [3, 1, 2], 0]
    unscattered = estimate.unscattered.reshape(count, -1).mean(axis=1)
    light = np.sqrt(4.0 * np.pi) * band_0 + unscattered
    along = unscattered - np.sqrt(4.0 * np.pi / 3.0) * np.sum(band_1 * outgoing, axis=1)
    return float(seen @ unscattered / (seen @ light)), float(seen @ along / (seen @ light))


def main() -> None:
    """Print a row for each object, phase function and thickness."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--queries", type=int, default=1500)
    count = parser.parse_args().queries
    print(f"{'object':8}{'phase_g':>8}{'thickness':>11}{'unscattered':>13}{'forward':>9}")
    for name, mesh in {"ball": sphere(), "spot": prt.read_mesh(prt.example("spot.obj"))}.items():
        for phase_g in (0.0, 0.8):
            for thickness in THICKNESS:
                unscattered, forward = shares(mesh, thickness, phase_g, count)
                print(f"{name:8}{phase_g:8g}{thickness:11g}{unscattered:13.1%}{forward:9.2f}", flush=True)


if __name__ == "__main__":
    main()
