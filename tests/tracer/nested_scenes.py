"""Small scenes of several parts, written to files and read back."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from formats.image import write_image
from formats.mesh import Mesh, write_mesh
from formats.scene import Scene, read_scene

CLEAR: dict[str, Any] = {"sigma_t": 0.0, "albedo": 1.0}


def nested_scene(
    folder: Path, mesh: Mesh, medium: dict[str, Any], inside: tuple[dict[str, Any], ...] = (), **interface: Any
) -> Scene:
    """Write an object with inner parts, and read the scene.

    Each part of `inside` has a mesh, the keys of [[inside]], and optional tables `medium` and `interface`. Grids, and
    textures of roughness and reflectance, may be arrays.
    """
    write_mesh(mesh, folder / "object.ply")
    lines = ['[object]\nmesh = "object.ply"\n[interface]', *_keys(folder, "object", interface), "[medium]"]
    lines += _keys(folder, "object", medium)
    for index, part in enumerate(inside):
        name = str(part.get("name", f"part {index}"))
        write_mesh(part["mesh"], folder / f"{name}.ply")
        plain = {key: value for key, value in part.items() if not isinstance(value, dict | Mesh)}
        lines += ["[[inside]]", *_keys(folder, name, plain | {"name": name, "mesh": f"{name}.ply"})]
        for table in ("interface", "medium"):
            if table in part:
                lines += [f"[inside.{table}]", *_keys(folder, name, part[table])]
    (folder / "scene.toml").write_text("\n".join(lines))
    return read_scene(folder / "scene.toml")


def _keys(folder: Path, name: str, table: dict[str, Any]) -> list[str]:
    written = {}
    for key, value in table.items():
        array = np.asarray(value)
        if key in ("roughness", "reflectance") and array.ndim >= 2:
            image = np.broadcast_to(array if array.ndim == 3 else array[..., None], (*array.shape[:2], 3))
            write_image(folder / f"{name}_{key}.exr", image.astype(np.float32))
            written[key] = f"{name}_{key}.exr"
        elif key != "bounds" and array.ndim >= 3:
            np.save(folder / f"{name}_{key}.npy", array)
            written[key] = f"{name}_{key}.npy"
        else:
            written[key] = array.tolist()
    return [f"{key} = {json.dumps(value)}" for key, value in written.items()]
