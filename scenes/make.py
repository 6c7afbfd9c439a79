"""Generates every mesh and texture of the scenes: `python -m scenes.make` writes them beside their scene files.

`--out FOLDER` writes to another folder; `--only grape` writes one scene. The head needs scikit-image.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from scenes import solids, statues, textures
from scenes.solids import turn_matrix

from formats.image import write_image

HERE = Path(__file__).parent


def grape(folder: Path) -> None:
    """A berry with a dimple at its stem, two seeds, the bloom's roughness and the seeds' reflectance."""
    theta = np.linspace(0.0, np.pi, 26)
    profile = np.stack([0.9 * np.sin(theta), -1.15 * np.cos(theta)], axis=1)
    profile[:, 1] -= 0.12 * np.exp(-((profile[:, 0] / 0.16) ** 2)) * (profile[:, 1] > 0)
    profile[[0, -1], 0] = 0.0
    solids.write(solids.revolution(profile, 40), folder / "grape.obj")
    pip = solids.ellipsoid((0.2, 0.42, 0.15), 12, 16)
    taper = 1 - 0.4 * pip.positions[:, 1:2] / 0.42
    pip = solids.Solid(pip.positions * np.hstack([taper, np.ones_like(taper), taper]), pip.faces, pip.corner_uv)
    for name, side in (("seed_left", -1.0), ("seed_right", 1.0)):
        turn = turn_matrix([0.0, 1.0, 0.2], 25 * side) @ turn_matrix([0.0, 0.0, 1.0], 8 * side)
        solids.write(pip.moved(turn=turn, offset=[0.3 * side, -0.1 + 0.08 * side, 0.05 * side]), folder / f"{name}.obj")
    Image.fromarray(textures.bloom()).save(folder / "bloom.png", optimize=True)
    write_image(folder / "seed.png", textures.seed_skin())


def dragon(folder: Path) -> None:
    """The serpent."""
    solids.write(statues.serpent(), folder / "serpent.obj")


def paperweight(folder: Path) -> None:
    """A cube with rounded edges that contains Spot, or a bunny of the same size."""
    solids.write(solids.rounded_box(1.1, 0.15).moved(offset=[0.0, 0.11, 0.19]), folder / "cube.obj")


def drink(folder: Path) -> None:
    """A closed glass, the liquid in it, and two floating ice cubes."""
    for name, outline in (("glass", (0.72, 0.95, -1.2, 1.2, 0.08)), ("liquid", (0.63, 0.86, -1.02, 1.1, 0.08))):
        solids.write(solids.plain(solids.revolution(solids.beaker(*outline), 48)), folder / f"{name}.obj")
    cube = solids.rounded_box(0.26, 0.06, bevel=2, flat=2)
    first = turn_matrix([0.2, 1.0, 0.1], 20) @ turn_matrix([1.0, 0.0, 0.4], 14)
    second = turn_matrix([0.1, 1.0, -0.3], 63) @ turn_matrix([0.3, 0.1, 1.0], 24)
    solids.write(cube.moved(turn=first, offset=[-0.37, 0.74, -0.12]), folder / "ice_left.obj")
    solids.write(cube.moved(turn=second, offset=[0.36, 0.66, 0.14]), folder / "ice_right.obj")


def lucy(folder: Path) -> None:
    """The robed figure."""
    solids.write(statues.figure(), folder / "figure.obj")


def head(folder: Path) -> None:
    """The head, and a dark sky with one bright pixel, a sun behind the head."""
    solids.write(statues.head(), folder / "head.obj")
    sky = np.zeros((32, 64, 3))
    sky[12, 52] = 2000.0
    write_image(folder / "sun.hdr", sky)


SCENES: dict[str, Callable[[Path], None]] = {
    **{"grape": grape, "dragon": dragon, "paperweight": paperweight},
    **{"drink": drink, "lucy": lucy, "head": head},
}


def make(out: Path, names: list[str]) -> None:
    """Write the meshes and textures of the named scenes into folders of those names under `out`."""
    for name in names:
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        SCENES[name](folder)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write every mesh and texture of the scenes.")
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--only", choices=SCENES)
    arguments = parser.parse_args()
    make(arguments.out, [arguments.only] if arguments.only else list(SCENES))
