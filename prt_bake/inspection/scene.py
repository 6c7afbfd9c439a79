"""Description, faults and remarks of a scene."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.mesh import check_mesh, good_normals, texture_remark
from formats.scene import Scene, read_scene
from formats.scene.file import find_table_faults
from formats.scene.materials import find_material
from formats.scene.parts import Part
from formats.scene.schema import MediumTable
from prt_bake.inspection import translucency


def describe(path: Path) -> dict[str, Any]:
    """Return the quantities of the object, then those of the parts inside it under their names."""
    scene = read_scene(path)
    tables = [scene.tables.medium, *(table.medium for table in scene.tables.inside)]
    length = scene.tables.object.length_in_mm
    outermost, *inner = [
        {**_describe_part(part), **_describe_materials(part, table), **_describe_translucency(part, length)}
        for part, table in zip(scene.parts, tables, strict=True)
    ]
    inside = {
        f"{part.name}: {name}": value
        for part, description in zip(scene.parts[1:], inner, strict=True)
        for name, value in {"in": scene.parts[part.parent].name, **description}.items()
    }
    return {
        **outermost,
        "up": scene.up,
        "unit": scene.unit,
        "parts": len(scene.parts),
        **inside,
        "content hash": scene.content_hash,
    }


def find_faults(path: Path) -> list[str]:
    """Return the faults of the tables; if there are none, raise the error of the meshes and grids, if any."""
    from prt_bake.geometry.nesting import refuse_outside
    from prt_bake.geometry.shells import refuse_ambiguous

    faults = find_table_faults(path)
    if not faults:
        parts = read_scene(path).parts
        size = float(np.ptp(parts[0].mesh.bounds, axis=0).max())
        for part in parts:
            refuse_ambiguous(part.mesh, part.mesh_path, size)
        refuse_outside(parts)
    return faults


def find_remarks(path: str | Path) -> list[str]:
    """Return remarks on a sound scene as sentences.

    They name faults of meshes that a scene mends, objects that will look opaque or clear, parts that stick out of
    their parents, grids beside their parts, the energy that rough boundaries lose to single scattering, images that
    repeat, facets, and scenes that networks learn badly.
    """
    from prt_bake.geometry.nesting import protruding_parts
    from prt_bake.trainer.scene_warnings import training_warning

    scene = read_scene(path)
    parts, warning = scene.parts, training_warning(scene)
    remarks = [
        *_mended_meshes(parts),
        *([appearance] if (appearance := appearance_remark(scene)) else []),
        *protruding_parts(parts),
        *_misplaced_grids(parts),
        *_energy_losses(parts),
        *_repeated_images(parts),
        *_facets(parts),
    ]
    return [f"{path}: {remark}" for remark in (*remarks, *([warning] if warning else []))]


def appearance_remark(scene: Scene) -> str:
    """Return a sentence if the outermost part will look opaque or clear, else an empty text.

    A clear one with parts inside has none, since they are what is seen.
    """
    light = translucency.of_medium(scene.medium, scene.parts[0].mesh)
    if light is None or (light.clear and len(scene.parts) > 1):
        return ""
    return translucency.remark(light, scene.tables.object.length_in_mm)


def _describe_part(part: Part) -> dict[str, Any]:
    description: dict[str, Any] = {
        "mesh": str(part.mesh_path),
        "vertices": len(part.mesh.positions),
        "faces": len(part.mesh.faces),
        "diagonal": part.mesh.diagonal,
    }
    if part.diffuse is not None:
        return {**description, "reflectance": _constant_or_array(part.diffuse, "texture")}
    assert part.medium is not None
    return {
        **description,
        "eta": part.eta,
        "roughness": _constant_or_array(part.roughness, "texture"),
        "normals": part.normals,
        "energy compensation": part.energy_compensation,
        "sigma_t": _constant_or_array(part.medium.sigma_t, "grid"),
        "albedo": _constant_or_array(part.medium.albedo, "grid"),
        "phase_g": part.medium.phase_g,
    }


def _describe_materials(part: Part, table: MediumTable | None) -> dict[str, str]:
    description = {}
    for key, used in {"material": table, "mixed with": table and table.mix}.items():
        if used and used.material:
            material = find_material(used.material)
            origin = "measured" if material.measured else "an estimate"
            density = "" if used.density == 1.0 else f" of density {used.density:g}"
            eta = f"{origin} with eta {material.eta:g}; the scene uses eta {part.eta:g}"
            description[key] = f"{material.name}{density}, {eta}"
    return description


def _describe_translucency(part: Part, length: float | None) -> dict[str, Any]:
    light = None if part.medium is None else translucency.of_medium(part.medium, part.mesh)
    return {} if light is None else translucency.describe(light, length)


def _mended_meshes(parts: tuple[Part, ...]) -> list[str]:
    """Return the faults of mesh files that `prtbake check MESH` finds, but that a scene can be rendered with."""
    paths = dict.fromkeys(part.mesh_path for part in parts)
    return [f"{fault} (the scene is rendered as if it were mended)" for path in paths for fault in check_mesh(path)]


def _constant_or_array(quantity: Any, kind: str) -> Any:
    values = np.asarray(quantity)
    if values.ndim < 2:
        return values.tolist()
    return f"{kind} {list(values.shape)}, {values.min():g} to {values.max():g}"


def _misplaced_grids(parts: tuple[Part, ...]) -> list[str]:
    """Return a sentence per part whose grids are probably elsewhere, of another size, or of another order of axes."""
    sentences = []
    for part in parts:
        if part.medium is None or part.medium.bounds is None:
            continue
        grids = [grid for grid in (part.medium.sigma_t, part.medium.albedo) if grid.ndim > 2]
        remarks = [_axis_order(grid.shape[:3], part.medium.bounds) for grid in grids]
        remarks.append(_misplacement(part, part.medium.bounds, grids))
        sentences += [f"{part.name!r}: {remark}" for remark in dict.fromkeys(remarks) if remark]
    return sentences


def _misplacement(part: Part, box: NDArray[np.float64], grids: list[NDArray[np.float64]]) -> str:
    """Compare the box of grids [2,3] with that of their part. The usual cause of a mismatch is a wrong unit."""
    bounds = part.mesh.bounds
    common = np.minimum(box[1], bounds[1]) - np.maximum(box[0], bounds[0])
    where = f"the grids' box {box.tolist()}"
    if (common <= 0).any():
        return (
            f"{where} does not overlap the part's box {bounds.tolist()}: the part is filled with the grids' border "
            f"values"
        )
    size = bounds[1] - bounds[0]
    if (common < 0.1 * size).all():
        return f"{where} is less than a tenth of the part's, {bounds.tolist()}: the rest is filled with border values"
    if all(((box[1] - box[0]) / grid.shape[2::-1] > size).all() for grid in grids):
        return f"{where} is so large that the part's, {bounds.tolist()}, is smaller than a cell of the grids"
    return ""


def _axis_order(shape: tuple[int, ...], box: NDArray[np.float64]) -> str:
    """Notice a grid [X,Y,Z]: its cells would be cubes, but as [Z,Y,X] they are not."""
    cells, reversed_cells = (box[1] - box[0]) / shape[::-1], (box[1] - box[0]) / shape
    if np.ptp(reversed_cells) > 0.05 * reversed_cells.max() or cells.max() < 1.5 * cells.min():
        return ""
    sides = " by ".join(f"{side:.3g}" for side in cells)
    return f"the cells of a grid {list(shape)} are {sides}; as [X,Y,Z] they would be cubes, but grids are [Z,Y,X]"


def _repeated_images(parts: tuple[Part, ...]) -> list[str]:
    """Return a sentence per textured part whose texture coordinates leave the image."""
    sentences = []
    for part in parts:
        textured = isinstance(part.roughness, np.ndarray) or (part.diffuse is not None and part.diffuse.ndim == 3)
        if textured and (remark := texture_remark(part.mesh)):
            sentences.append(f"{part.name!r}: {remark}")
    return sentences


def _facets(parts: tuple[Part, ...]) -> list[str]:
    """Return a sentence on the boundaries that refract light by faces although their vertex normals are good."""
    faceted = [part for part in parts if part.diffuse is None and part.normals == "face"]
    refracting = [part for part in faceted if part.eta != (1.0 if part.parent < 0 else parts[part.parent].eta)]
    names = [repr(part.name) for part in refracting if good_normals(part.mesh)]
    if not names:
        return []
    return [
        f"{', '.join(names)}: light is refracted by the faces, so that a coarse mesh shows facets; "
        'normals = "vertex" uses the vertex normals, which are good'
    ]


def _energy_losses(parts: tuple[Part, ...]) -> list[str]:
    """Return a sentence per rough boundary between two indices: the energy that single scattering loses."""
    sentences = []
    for part in parts:
        outside = 1.0 if part.parent < 0 else parts[part.parent].eta
        alpha, eta = float(np.mean(part.roughness)), part.eta / outside
        if part.diffuse is not None or alpha == 0.0 or eta == 1.0:
            continue
        from prt_bake.tracer.surface.losses import furnace_loss

        model = f"{part.name!r}: at roughness {alpha:.3g} and relative eta {eta:.4g} single scattering"
        loss = f"{furnace_loss(alpha, eta):.1%} of a white furnace"
        if part.energy_compensation:
            sentences.append(f"{model} would lose {loss}; energy_compensation restores it")
        else:
            sentences.append(
                f"{model} loses {loss}, as in other renderers; where only the look matters, energy_compensation = true "
                "restores it"
            )
    return sentences
