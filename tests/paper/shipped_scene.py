"""The shipped object as a scene of the paper."""

import shutil
from pathlib import Path

from formats.mesh import read_mesh
from prt_bake.importance.module import ImportanceModule, save_importance
from prt_bake.importance.settings import ImportanceSettings
from prt_bake.shipped.demonstration import SHIPPED


def write_scenes(folder: Path, name: str) -> Path:
    """Write the shipped scene, and its network with an importance module as the model of the scene `name`."""
    for file in ("spot.toml", "spot.obj", "sigma_t.npy", "albedo.npy"):
        shutil.copy(SHIPPED / file, folder / file)
    (folder / "models").mkdir()
    model = folder / f"models/{name}.pt"
    shutil.copy(SHIPPED / "spot.pt", model)
    low, high = read_mesh(SHIPPED / "spot.obj").bounds
    save_importance(ImportanceModule(ImportanceSettings(), low, float((high - low).max())), model)
    return folder
