"""The record of a scene, read from a TOML file: a closed object, the parts inside it, and their media."""

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from formats.scene.file import parse_scene
from formats.scene.medium import Medium
from formats.scene.parts import Part, read_parts
from formats.scene.schema import SceneFile
from formats.summary import summary

__all__ = ["Medium", "Part", "Scene", "read_scene"]


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene with all its files loaded. Lengths are in scene units, `sigma_t` is per scene unit.

    A point belongs to the deepest part that contains it; a part exists only inside its parent, and of overlapping
    siblings the later one wins. Properties with the name of an attribute of `Part` return that of the outermost part.

    Attributes:
        path: the TOML file.
        tables: the validated tables of the file.
        up: the axis that points up.
        unit: name of the unit of length.
        parts: the outermost first, then the others in file order.
        content_hash: SHA-256 of everything that affects the transport: meshes, nesting, interfaces, textures, media.

    >>> import prt_bake as prt
    >>> scene = prt.load_scene(prt.example("spot.toml"))
    >>> isinstance(scene, prt.Scene), scene.unit, scene.roughness, len(scene.parts)
    (True, 'dm', 0.3, 1)
    """

    path: Path
    tables: SceneFile
    up: Literal["y", "z"]
    unit: str
    parts: tuple[Part, ...]
    content_hash: str = ""

    @property
    def mesh_path(self) -> Path:
        """The mesh file of the outermost part."""
        return self.parts[0].mesh_path

    @property
    def mesh(self) -> Mesh:
        """The outermost surface: closed, faces counter-clockwise seen from outside."""
        return self.parts[0].mesh

    @property
    def flipped(self) -> bool:
        """Whether the faces in the mesh file are wound inside out."""
        return self.parts[0].flipped

    @property
    def eta(self) -> float:
        """Absolute index of refraction inside (1 outside); 1 is index-matched."""
        return self.parts[0].eta

    @property
    def roughness(self) -> float | NDArray[np.float64]:
        """GGX alpha, 0 is smooth; or a texture [H,W]."""
        return self.parts[0].roughness

    @property
    def normals(self) -> Literal["face", "vertex"]:
        """The normals of the interface."""
        return self.parts[0].normals

    @property
    def medium(self) -> Medium:
        """The medium of the outermost part, which is never diffuse."""
        medium = self.parts[0].medium
        assert medium is not None
        return medium

    @property
    def sigma_t(self) -> float | NDArray[np.float64]:
        """Extinction: a number, RGB [3], or a float64 grid [Z,Y,X] or [Z,Y,X,3]."""
        sigma_t = self.medium.sigma_t
        return float(sigma_t) if sigma_t.ndim == 0 else sigma_t

    @property
    def albedo(self) -> NDArray[np.float64]:
        """Single-scattering albedo in [0,1], float64: RGB [3], or a grid [Z,Y,X] or [Z,Y,X,3]."""
        return self.medium.albedo

    @property
    def phase_g(self) -> float:
        """Mean cosine of the Henyey–Greenstein phase function."""
        return self.medium.phase_g

    @property
    def bounds(self) -> NDArray[np.float64] | None:
        """Lowest and highest corner of the box of the grids, float64 [2,3]; None without grids."""
        return self.medium.bounds

    __repr__ = summary


def read_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene file and the meshes, textures and grids that it names, relative to its folder.

    Raises:
        SceneError: an unknown key, a value out of range, an invalid grid or texture, a mesh that is not closed, parts
            that do not nest; the message names the key.
        MeshError, ImageError: a mesh or texture is damaged.
        StorageError: a file is missing.

    >>> import prt_bake as prt
    >>> scene = prt.load_scene(prt.example("spot.toml"))
    >>> scene.eta, scene.mesh.faces.shape, scene.sigma_t.shape, scene.albedo.shape
    (1.3, (5856, 3), (36, 36, 20), (36, 36, 20, 3))
    """
    path = Path(path)
    tables = parse_scene(path)
    scene = Scene(path, tables, tables.object.up, tables.object.stated_unit, read_parts(tables, path))
    return dataclasses.replace(scene, content_hash=_content_hash(scene.parts))


def _content_hash(parts: tuple[Part, ...]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(_hashed_content(part))
    return digest.hexdigest()


def _hashed_content(part: Part) -> bytes:
    """Return everything that affects the transport of a part, as bytes; later keys only if they are not default."""
    textured = isinstance(part.roughness, np.ndarray) or (part.diffuse is not None and part.diffuse.ndim == 3)
    medium = part.medium
    values: list[object] = [
        part.mesh.content_hash,
        part.eta,
        "texture" if isinstance(part.roughness, np.ndarray) else part.roughness,
        part.normals,
        0.0 if medium is None else medium.phase_g,
    ]
    values += ["energy compensation"] if part.energy_compensation else []
    values += [{"parent": part.parent, "diffuse": medium is None}] if part.parent >= 0 else []
    arrays = [None] * 3 if medium is None else [medium.sigma_t, medium.albedo, medium.bounds]
    arrays += [] if part.diffuse is None else [part.diffuse]
    arrays += [part.roughness] if isinstance(part.roughness, np.ndarray) else []
    arrays += [part.mesh.corner_uv] if textured else []
    pieces = [json.dumps(values, allow_nan=False).encode()]
    for each in arrays:
        array = np.zeros(0) if each is None else np.asarray(each, "<f8")
        pieces += [json.dumps(array.shape, allow_nan=False).encode(), np.ascontiguousarray(array).tobytes()]
    return b"".join(pieces)
