"""The shipped files that users may take as examples: a scene, its mesh, grids, model, sky and reference picture."""

import shutil
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

from formats.errors import QueryError, StorageError

NAMES = ("spot.toml", "spot.obj", "sigma_t.npy", "albedo.npy", "spot.pt", "sky.hdr", "reference.exr")
"""A marble cow: scene, mesh, its medium's grids, trained model, a sky, and a path-traced picture under it."""


def example(name: str) -> Path:
    """Return the path of a shipped file, to be read and not to be changed.

    Args:
        name: spot.toml (a scene), spot.obj (its mesh), sigma_t.npy or albedo.npy (its medium), spot.pt (its trained
            model), sky.hdr (a lat-long sky) or reference.exr (a path-traced picture under that sky).

    Raises:
        QueryError: there is no such example.

    >>> import prt_bake as prt
    >>> mesh = prt.read_mesh(prt.example("spot.obj"))
    >>> mesh.positions.shape
    (2930, 3)
    """
    if name not in NAMES:
        raise QueryError(f"example: there is none with the name {name!r}; expected one of {', '.join(NAMES)}")
    return Path(str(resources.files("prt_bake.shipped"))) / name


def copy_examples(folder: Path) -> Iterator[Path]:
    """Copy every example into a folder, which is created; yields the path of each copy.

    Raises:
        StorageError: one of the files exists there, or the folder cannot be written.
    """
    copies = [folder / name for name in NAMES]
    for path in copies:
        if path.exists():
            raise StorageError(f"{path}: already exists; choose a new folder for the example")
    for path in copies:
        shutil.copyfile(example(path.name), path)
        yield path
