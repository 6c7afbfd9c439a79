"""Share of queries that the path tracer flags as unreliable in the repository's scenes, by the number of paths.

    python -m tests.bench.reliable_share [NAME …] [--paths 16384] [--most 65536] [--queries 30]

Queries are random: x uniform over the area, ωo over the hemisphere above it, and one ωi over the sphere, so that half
of the light comes from behind. The number of paths grows fourfold from --paths to --most. `enough` marks rows with at
most one flagged query in twenty, `error` is the median standard error over the value. Scenes behind a smooth interface
have no values of Ŝ and are skipped.
"""

import argparse
from pathlib import Path

import numpy as np

from formats.scene import Scene, read_scene
from prt_bake.tracer.estimate import estimate_transport
from tests.tracer.scenes import queries, unit_directions
from tests.tracer.soundness import has_connections

ROOT = Path(__file__).parents[2]
ALLOWED = 0.05


def shipped(names: list[str]) -> dict[str, Scene]:
    """The repository's scenes by name, all of them if `names` is empty; scenes without their meshes are skipped."""
    paths = [*sorted((ROOT / "scenes").glob("*/*.toml")), ROOT / "prt_bake" / "shipped" / "spot.toml"]
    found = {}
    for path in paths:
        if names and path.stem not in names:
            continue
        try:
            found[path.stem] = read_scene(path)
        except OSError as error:
            print(f"{path.stem:14}{error}")
    return found


def measure(name: str, scene: Scene, count: int, least: int, most: int, seed: int) -> None:
    """Print a row for every number of paths."""
    positions, outgoing, _ = queries(scene.mesh, count, seed)
    incident = unit_directions(count, seed + 66)
    paths = least
    while paths <= most:
        estimate = estimate_transport(scene, positions, outgoing, incident, paths, 1)
        share = 1.0 - float(estimate.reliable.mean())
        error = float(np.median(estimate.standard_error / np.maximum(estimate.mean, 1e-300)))
        enough = "enough" if share < ALLOWED + 1e-9 else ""
        print(f"{name:14}{paths:9d}{100 * share:11.1f} %{error:9.3f}{estimate.seconds:10.1f}  {enough}", flush=True)
        paths *= 4


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--paths", type=int, default=16384)
    parser.add_argument("--most", type=int, default=65536)
    parser.add_argument("--queries", type=int, default=30)
    parser.add_argument("--seed", type=int, default=11)
    args = parser.parse_args()
    print(f"{'scene':14}{'paths':>9}{'unreliable':>13}{'error':>9}{'seconds':>10}")
    for name, scene in shipped(args.names).items():
        if has_connections(scene):
            measure(name, scene, args.queries, args.paths, args.most, args.seed)


if __name__ == "__main__":
    main()
