"""The parts of a scene: nested closed surfaces, each with its boundary and its medium."""

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError, warn
from formats.file_names import named_file
from formats.image.texture import read_reflectance_texture, read_roughness_texture
from formats.mesh import SPLIT_ANGLE, Mesh, closedness_faults, flipped, read_mesh, signed_volume, texture_fault
from formats.scene.file import errors_at, refuse_quoted_number
from formats.scene.medium import Medium, MediumContext, clear_medium, read_medium
from formats.scene.schema import InsideTable, InterfaceTable, SceneFile
from formats.summary import summary

MOST_PARTS = 12
"""Parts of a scene, the outermost included."""
_MOST_SIZE = 10.0
"""Diagonal of a part over that of its parent, beyond which the unit is probably wrong."""
_LEAST_SIZE = 1.0 / 500.0
"""Diagonal of a part over that of its parent, below which the unit is probably wrong; bubbles are larger."""
OUTERMOST = "object"
"""The name of the outermost part."""


@dataclass(frozen=True, eq=False)
class Part:
    """One closed surface and its medium.

    Attributes:
        name: as in the file; "object" for the outermost part.
        parent: index of the enclosing part; -1 for the outermost.
        mesh_path: the mesh file.
        mesh: closed, of consistent winding, faces counter-clockwise seen from outside.
        flipped: whether the faces in the file are wound inside out.
        eta: absolute index of refraction inside (1 outside the scene); index-matched if equal to the parent's.
        roughness: GGX alpha, 0 is smooth; or a texture float64 [H,W], row 0 on top, mapped by `mesh.corner_uv`.
        normals: the normals of the boundary, "face" or "vertex".
        energy_compensation: whether to restore the energy that single scattering on a rough boundary loses.
        diffuse: linear reflectance float64 [3] or a texture [H,W,3], row 0 on top; None for a dielectric boundary.
        medium: the medium inside; None for a diffuse boundary.
    """

    name: str
    parent: int
    mesh_path: Path
    mesh: Mesh
    flipped: bool
    eta: float
    roughness: float | NDArray[np.float64]
    normals: Literal["face", "vertex"]
    energy_compensation: bool
    diffuse: NDArray[np.float64] | None
    medium: Medium | None

    __repr__ = summary


def read_parts(tables: SceneFile, path: Path) -> tuple[Part, ...]:
    """Load the parts of a scene, the outermost first, then the others in file order.

    Raises:
        SceneError: duplicate or unknown names, a nesting cycle, a mesh that is not closed or lies outside its parent,
            an invalid texture or grid; the message names the key.
        MeshError, ImageError: a file is damaged.
        StorageError: a file is missing.
    """
    parents = _parents(tables.inside, path)
    parts: dict[int, Part] = {0: _outermost(tables, path)}
    while len(parts) <= len(tables.inside):
        for index in range(1, len(parents)):
            if index not in parts and parents[index] in parts:
                parts[index] = _inner(tables, index, parents[index], parts[parents[index]], path)
    return tuple(parts[index] for index in sorted(parts))


def _outermost(tables: SceneFile, path: Path) -> Part:
    mesh_path = named_file(path, tables.object.mesh)
    mesh, was_flipped = _closed_mesh(mesh_path, path, "object.mesh")
    _warn_of_rounded_edges(mesh, tables.interface, f"{path}: interface.normals: {mesh_path}")
    return Part(
        name=OUTERMOST,
        parent=-1,
        mesh_path=mesh_path,
        mesh=mesh,
        flipped=was_flipped,
        eta=1.0 if tables.interface.eta is None else tables.interface.eta,
        roughness=_roughness(tables.interface, mesh, path, "interface"),
        normals=tables.interface.normals,
        energy_compensation=tables.interface.energy_compensation,
        diffuse=None,
        medium=read_medium(tables.medium, MediumContext(path, "medium", mesh.bounds, tables.object)),
    )


def _inner(tables: SceneFile, index: int, parent_index: int, parent: Part, path: Path) -> Part:
    table, key = tables.inside[index - 1], f"inside.{index - 1}"
    if parent.diffuse is not None:
        raise SceneError(
            f"{path}: {key}.in: {table.name!r} lies in {parent.name!r}, which is diffuse and lets no light in; put it "
            f"into a dielectric"
        )
    mesh_path = named_file(path, table.mesh)
    mesh, was_flipped = _closed_mesh(mesh_path, path, f"{key}.mesh")
    _refuse_outside(mesh, parent, f"{path}: {key}.mesh: {mesh_path}")
    interface = table.interface or InterfaceTable()
    _warn_of_rounded_edges(mesh, interface, f"{path}: {key}.interface.normals: {mesh_path}")
    diffuse = _reflectance(table, mesh, path, key) if table.surface == "diffuse" else None
    context = MediumContext(path, f"{key}.medium", mesh.bounds, tables.object)
    medium = clear_medium() if table.medium is None else read_medium(table.medium, context)
    return Part(
        name=table.name,
        parent=parent_index,
        mesh_path=mesh_path,
        mesh=mesh,
        flipped=was_flipped,
        eta=parent.eta if interface.eta is None else interface.eta,
        roughness=_roughness(interface, mesh, path, f"{key}.interface"),
        normals=interface.normals,
        energy_compensation=interface.energy_compensation,
        diffuse=diffuse,
        medium=None if diffuse is not None else medium,
    )


def _parents(inside: tuple[InsideTable, ...], path: Path) -> list[int]:
    """Return the index of the parent of each part, -1 for the outermost; raises SceneError for a cycle."""
    if len(inside) >= MOST_PARTS:
        raise SceneError(
            f"{path}: inside: expected at most {MOST_PARTS} parts including the outermost, found {len(inside) + 1}; "
            f"merge objects of one material into one mesh"
        )
    names = [OUTERMOST]
    for i, table in enumerate(inside):
        if table.name in names:
            raise SceneError(
                f"{path}: inside.{i}.name: another part is named {table.name!r}; give every part its own name"
            )
        names.append(table.name)
    parents = [-1]
    for i, table in enumerate(inside):
        parent = OUTERMOST if table.inside_of is None else table.inside_of
        if parent not in names:
            close = difflib.get_close_matches(parent, names, n=1)
            advice = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(names)}"
            raise SceneError(f"{path}: inside.{i}.in: there is no part {parent!r}; {advice}")
        parents.append(names.index(parent))
    for i in range(1, len(parents)):
        chain = [i]
        while parents[chain[-1]] > 0:
            chain.append(parents[chain[-1]])
            if chain[-1] == i:
                cycle = " in ".join(repr(names[index]) for index in chain)
                raise SceneError(f"{path}: inside.{i - 1}.in: parts are nested in a cycle: {cycle}; change one of them")
            if len(chain) > len(parents):
                break  # The cycle does not contain part i; another start reports it.
    return parents


def _closed_mesh(mesh_path: Path, path: Path, key: str) -> tuple[Mesh, bool]:
    with errors_at(path, key):
        mesh = read_mesh(mesh_path)
    if faults := closedness_faults(mesh):
        raise SceneError(f"{path}: {key}: {mesh_path} does not bound a solid: {faults[0]}")
    return (flipped(mesh), True) if signed_volume(mesh) < 0 else (mesh, False)


def _refuse_outside(mesh: Mesh, parent: Part, where: str) -> None:
    (low, high), (parent_low, parent_high) = mesh.bounds, parent.mesh.bounds
    if (low >= parent_high).any() or (high <= parent_low).any():
        raise SceneError(
            f"{where} lies completely outside {parent.name!r}: its box is {_box(mesh)}, expected one that overlaps "
            f"{_box(parent.mesh)}; move it, or check the unit of length"
        )
    if mesh.diagonal > _MOST_SIZE * parent.mesh.diagonal:
        warn(
            f"{where} is {mesh.diagonal / parent.mesh.diagonal:.3g} times as large as {parent.name!r}, which it may "
            f"fill; check the unit of length"
        )
    if mesh.diagonal < _LEAST_SIZE * parent.mesh.diagonal:
        warn(
            f"{where} is {parent.mesh.diagonal / mesh.diagonal:.3g} times smaller than {parent.name!r}; check the unit "
            f"of length"
        )


def _warn_of_rounded_edges(mesh: Mesh, interface: InterfaceTable, where: str) -> None:
    """Warn if the boundary has vertex normals and the file has several at a vertex, of which a mesh has the mean."""
    if interface.normals == "vertex" and mesh.split_normals:
        warn(
            f"{where} has hard edges: at {mesh.split_normals} of {len(mesh.positions)} vertices its normals differ by "
            f'more than {SPLIT_ANGLE:g} degrees, and "vertex" takes their mean, which rounds the edges off; bevel the '
            f'edges, or say normals = "face"'
        )


def _box(mesh: Mesh) -> str:
    return " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in mesh.bounds)


def _roughness(interface: InterfaceTable, mesh: Mesh, path: Path, key: str) -> float | NDArray[np.float64]:
    if not isinstance(interface.roughness, str):
        return interface.roughness
    refuse_quoted_number(path, f"{key}.roughness", interface.roughness)
    _require_uv(mesh, f"{path}: {key}.roughness")
    with errors_at(path, f"{key}.roughness"):
        return read_roughness_texture(path, f"{key}.roughness", interface.roughness)


def _reflectance(table: InsideTable, mesh: Mesh, path: Path, key: str) -> NDArray[np.float64]:
    if isinstance(table.reflectance, str):
        refuse_quoted_number(path, f"{key}.reflectance", table.reflectance)
        _require_uv(mesh, f"{path}: {key}.reflectance")
        with errors_at(path, f"{key}.reflectance"):
            return read_reflectance_texture(path, f"{key}.reflectance", table.reflectance)
    return np.broadcast_to(np.asarray(table.reflectance, np.float64), 3).copy()


def _require_uv(mesh: Mesh, where: str) -> None:
    if mesh.corner_uv is None:
        raise SceneError(
            f"{where}: an image needs texture coordinates, but the mesh has none, or not at every corner; unwrap the "
            f"mesh in an editor, or give a number"
        )
    if fault := texture_fault(mesh):
        raise SceneError(f"{where}: an image needs texture coordinates, but {fault}")
