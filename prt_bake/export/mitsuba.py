"""Converts a scene to Mitsuba 3: a dictionary for `mi.load_dict`, and the meshes, grids and images it refers to.

The dictionary holds plain numbers, strings and file names, so that writing it does not need Mitsuba (the extra
`validate` installs it). Plugins: https://mitsuba.readthedocs.io/en/stable/src/plugin_reference.html
"""

import os
import struct
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.atomic import replacing
from formats.errors import QueryError, SceneError, StorageError
from formats.image import write_image
from formats.mesh.ply import write_ply
from formats.scene import Scene
from formats.scene.medium import Medium
from formats.scene.parts import Part
from prt_bake.geometry.nesting import TOLERANCE, distances, protruding_parts, winding_numbers

_SMOOTHEST = 1e-4
"""Below this alpha a boundary is smooth, as in the path tracer."""
_EVENTS_WITHOUT_ROULETTE = 2000
"""Mitsuba's Russian roulette after 5 events multiplies the variance if the albedo is near 1."""

ENDINGS = (".ply", "_reflectance.exr", "_alpha.exr", "_sigma_t.vol", "_albedo.vol")
"""Ends of the names of the files that a part may have."""

Array = NDArray[np.float64]


def mitsuba_dictionary(
    scene: Scene,
    folder: str | os.PathLike[str],
    *,
    incident: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    scale: float = 1.0,
) -> dict[str, Any]:
    """Return the scene as a dictionary for `mi.load_dict`; writes its meshes, grids and images into `folder`.

    A point x of the scene becomes (x − origin) · scale. Radiance is unchanged.

    Args:
        scene: a scene whose parts lie inside one another.
        folder: an existing folder.
        incident: [3], unit direction to a distant light of unit irradiance, so that the outgoing radiance is Ŝ plus the
            surface reflection. By default a constant environment of radiance 1.
        origin: [3], by default the centre of the bounding box, because Mitsuba stores positions as float32.
        scale: Mitsuba's units per scene unit.

    Raises:
        SceneError: a part sticks out of its parent or overlaps a sibling, or uses energy compensation; Mitsuba supports
            neither.
        QueryError: `incident` is not a unit vector.
        StorageError: the folder is missing or not writable.

    Example:
        >>> import tempfile
        >>> import prt_bake as prt
        >>> scene = prt.load_scene(prt.example("spot.toml"))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     world = prt.mitsuba_dictionary(scene, folder)
        >>> world["shape_0"]["bsdf"]["type"], world["medium_0"]["type"]
        ('roughdielectric', 'heterogeneous')
    """
    _refuse_unknown_to_mitsuba(scene)
    target = Path(folder)
    if not target.is_dir():
        raise StorageError(f"{folder}: there is no such folder; create it first")
    center = scene.mesh.center if origin is None else np.asarray(origin, np.float64)
    chromatic = any(part.medium is not None and _by_channel(part.medium) for part in scene.parts)
    integrator = {
        "type": "volpathmis" if chromatic else "volpath",
        "max_depth": -1,
        "rr_depth": _EVENTS_WITHOUT_ROULETTE,
    }
    world: dict[str, Any] = {"type": "scene", "integrator": integrator, "light": _light(incident)}
    for index, part in enumerate(scene.parts):
        if part.medium is not None and part.medium.sigma_t.any():
            world[f"medium_{index}"] = _medium(part.medium, target / f"part_{index}", center, scale)
    for index, part in enumerate(scene.parts):
        shape = _shape(part, target / f"part_{index}", center, scale)
        around = 1.0 if part.parent < 0 else scene.parts[part.parent].eta
        shape["bsdf"] = _boundary(part, around, target / f"part_{index}")
        for side, filling in (("interior", index), ("exterior", part.parent)):
            if f"medium_{filling}" in world:
                shape[side] = {"type": "ref", "id": f"medium_{filling}"}
        world[f"shape_{index}"] = shape
    return world


def _refuse_unknown_to_mitsuba(scene: Scene) -> None:
    for part in scene.parts:
        if part.energy_compensation:
            raise SceneError(
                f"{scene.path}: {part.name!r}: energy_compensation: not supported by Mitsuba; export the scene without "
                "it"
            )
    sentences = protruding_parts(scene.parts) + _overlaps(scene.parts)
    if sentences:
        raise SceneError(
            f"{scene.path}: {sentences[0]}; Mitsuba needs parts that lie completely inside or outside one another: cut "
            "the meshes in an editor"
        )


def _overlaps(parts: tuple[Part, ...]) -> list[str]:
    """Return a sentence per pair of overlapping siblings: one has vertices inside the other."""
    sentences = []
    for one, other in combinations(parts[1:], 2):
        if one.parent != other.parent:
            continue
        for a, b in ((one.mesh, other.mesh), (other.mesh, one.mesh)):
            low, high = a.bounds
            near = b.positions[((b.positions >= low) & (b.positions <= high)).all(axis=1)]
            inside = near[winding_numbers(a, near) > 0.5]
            if distances(a, inside).max(initial=0.0) > TOLERANCE * a.diagonal:
                sentences.append(f"{one.name!r} and {other.name!r} overlap")
                break
    return sentences


def _light(incident: ArrayLike | None) -> dict[str, Any]:
    white = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
    if incident is None:
        return {"type": "constant", "radiance": white}
    direction = np.asarray(incident, np.float64)
    if direction.shape != (3,) or not abs(np.linalg.norm(direction) - 1.0) < 1e-4:
        raise QueryError(f"incident: expected a unit vector [3], found {direction.tolist()}")
    return {"type": "directional", "direction": (-direction).tolist(), "irradiance": white}


def _shape(part: Part, stem: Path, center: Array, scale: float) -> dict[str, Any]:
    """Write the mesh. A textured one gets separate vertices per face, for seams, and v downwards as in Mitsuba."""
    mesh, uv = part.mesh, None
    positions, faces, normals = (mesh.positions - center) * scale, mesh.faces, mesh.normals
    if mesh.corner_uv is not None and _is_textured(part):
        positions, normals = positions[faces].reshape(-1, 3), normals[faces].reshape(-1, 3)
        uv = mesh.corner_uv.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]
        faces = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
    path = stem.with_suffix(".ply")
    with replacing(path) as part_path:
        write_ply(part_path, positions, faces, normals, uv)
    return {"type": "ply", "filename": str(path), "face_normals": part.normals == "face"}


def _is_textured(part: Part) -> bool:
    return isinstance(part.roughness, np.ndarray) or (part.diffuse is not None and part.diffuse.ndim == 3)


def _boundary(part: Part, around: float, stem: Path) -> dict[str, Any]:
    if part.diffuse is not None:
        reflectance = (
            _image(part.diffuse, stem.with_name(f"{stem.name}_reflectance.exr"))
            if part.diffuse.ndim == 3
            else {"type": "rgb", "value": part.diffuse.tolist()}
        )
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    if part.eta == around:
        return {"type": "null"}
    indices = {"int_ior": float(part.eta), "ext_ior": float(around)}
    if isinstance(part.roughness, np.ndarray):
        alpha: Any = _image(np.repeat(part.roughness[..., None], 3, axis=2), stem.with_name(f"{stem.name}_alpha.exr"))
    elif part.roughness < _SMOOTHEST:
        return {"type": "dielectric", **indices}
    else:
        alpha = float(part.roughness)
    return {"type": "roughdielectric", "distribution": "ggx", "alpha": alpha, **indices}


def _image(image: Array, path: Path) -> dict[str, Any]:
    write_image(path, image)
    return {"type": "bitmap", "filename": str(path), "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def _medium(medium: Medium, stem: Path, center: Array, scale: float) -> dict[str, Any]:
    box = None if medium.bounds is None else (medium.bounds - center) * scale
    sigma_t, albedo = medium.sigma_t / scale, medium.albedo
    varies = sigma_t.ndim >= 3 or albedo.ndim >= 3
    return {
        "type": "heterogeneous" if varies else "homogeneous",
        "sigma_t": _volume(sigma_t, box, stem.with_name(f"{stem.name}_sigma_t.vol")),
        "albedo": _volume(albedo, box, stem.with_name(f"{stem.name}_albedo.vol")),
        "phase": {"type": "hg", "g": float(medium.phase_g)},
        "has_spectral_extinction": _by_channel(medium),
    }


def _by_channel(medium: Medium) -> bool:
    sigma_t = medium.sigma_t
    return sigma_t.ndim in (1, 4) and bool(np.ptp(sigma_t, axis=-1).any())


def _volume(quantity: Array, box: Array | None, path: Path) -> Any:
    if quantity.ndim == 0:
        return float(quantity)
    if quantity.ndim == 1:
        return {"type": "constvolume", "value": {"type": "rgb", "value": quantity.tolist()}}
    assert box is not None
    _write_volume(path, quantity if quantity.ndim == 4 else quantity[..., None], box)
    return {
        "type": "gridvolume",
        "filename": str(path),
        "use_grid_bbox": True,
        "raw": True,
        "filter_type": "trilinear",
        "wrap_mode": "clamp",
    }


def _write_volume(path: Path, grid: Array, box: Array) -> None:
    """Write a grid [Z,Y,X,C] over a box [2,3] in Mitsuba's binary volume format, version 3, float32."""
    z, y, x, channels = grid.shape
    with replacing(path) as part_path, open(part_path, "wb") as file:
        file.write(b"VOL" + struct.pack("<B5i6f", 3, 1, x, y, z, channels, *box.ravel()))
        file.write(np.ascontiguousarray(grid, "<f4").tobytes())
