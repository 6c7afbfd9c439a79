"""What a file holds and whether it is sound, whichever of the kinds it is: mesh, sky, scene, model, importance module,
asset or samples.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from formats.atomic import existing
from formats.errors import FormatError, PrtbakeError

if TYPE_CHECKING:
    from formats.scene.parts import Part
    from formats.scene.schema import MediumTable

SUFFIXES = {
    "mesh": (".ply", ".obj", ".glb", ".gltf"),
    "sky": (".exr", ".hdr", ".png"),
    "scene": (".toml",),
    "model": (".pt", ".safetensors"),
    "asset": (".h5", ".hdf5"),
}


def kind_of(path: str | Path) -> str:
    """Return "mesh", "sky", "scene", "model", "importance", "asset" or "samples", by the file's name and, of HDF5,
    by what it says.

    Raises:
        StorageError: there is no such file.
        FormatError: no kind has this suffix.
    """
    suffix = existing(path).suffix.lower()
    if suffix in SUFFIXES["model"] and Path(path).stem.endswith(".importance"):
        return "importance"
    for kind, suffixes in SUFFIXES.items():
        if suffix in suffixes:
            return "samples" if kind == "asset" and _is_samples(path) else kind
    known = ", ".join(suffix for suffixes in SUFFIXES.values() for suffix in suffixes)
    raise FormatError(f"{path}: cannot tell what this is by its suffix {suffix!r}; expected one of {known}")


def _is_samples(path: str | Path) -> bool:
    from formats.samples import is_samples

    return is_samples(path)


def describe(path: str | Path) -> dict[str, Any]:
    """Return what a file holds as plain JSON values under readable names; lengths are in scene units.

    Raises:
        PrtbakeError: the file cannot be read as what its suffix says.
    """
    kind = kind_of(path)
    return {"kind": kind, "bytes": Path(path).stat().st_size, **_DESCRIBE[kind](Path(path))}


def find_faults(path: str | Path) -> list[str]:
    """Return every fault of a file as a sentence; an empty list means that it is sound.

    Raises:
        StorageError: there is no such file.
        FormatError: the suffix belongs to none of the kinds.
    """
    kind = kind_of(path)
    try:
        return _FIND_FAULTS[kind](Path(path))
    except PrtbakeError as fault:
        return [str(fault)]


def find_remarks(path: str | Path) -> list[str]:
    """Return what is worth knowing of a sound file, as sentences: parts of a scene that stick out or that their grids
    do not reach, what share of a white furnace each rough boundary loses, since single scattering ends paths at a
    second microfacet, and what networks hardly learn.

    Raises:
        PrtbakeError: the file cannot be read as what its suffix says.
    """
    if kind_of(path) != "scene":
        return []
    from formats.scene import read_scene
    from prt_bake.geometry.nesting import protruding_parts
    from prt_bake.trainer.scene_remarks import training_warning

    scene = read_scene(path)
    parts, hard = scene.parts, training_warning(scene)
    every = (*protruding_parts(parts), *_beside(parts), *_losing(parts), *([hard] if hard else []))
    return [f"{path}: {sentence}" for sentence in every]


def _beside(parts: "tuple[Part, ...]") -> list[str]:
    """A sentence for every part that its grids do not reach: most often the unit of length is wrong."""
    sentences = []
    for part in parts:
        box = None if part.medium is None else part.medium.bounds
        if box is None:
            continue
        common = np.maximum(box[0], part.mesh.bounds[0]), np.minimum(box[1], part.mesh.bounds[1])
        if (common[0] >= common[1]).any():
            sentences.append(
                f"{part.name!r}: the grids' box {box.tolist()} lies wholly beside the part's, "
                f"{part.mesh.bounds.tolist()}: the part is filled with what lies at the grids' rim"
            )
    return sentences


def _losing(parts: "tuple[Part, ...]") -> list[str]:
    """A sentence for every rough boundary between two indices."""
    sentences = []
    for part in parts:
        outside = 1.0 if part.parent < 0 else parts[part.parent].eta
        alpha, eta = float(np.mean(part.roughness)), part.eta / outside
        if part.diffuse is not None or alpha == 0.0 or eta == 1.0:
            continue
        from prt_bake.tracer.surface.losses import furnace_loss

        told = f"{part.name!r}: at roughness {alpha:.3g} and relative eta {eta:.4g} single scattering"
        loss = f"{furnace_loss(alpha, eta):.1%} of a white furnace"
        if part.energy_compensation:
            sentences.append(f"{told} would lose {loss}; energy_compensation gives it back")
        else:
            sentences.append(f"{told} loses {loss}; energy_compensation = true gives it back")
    return sentences


def _describe_mesh(path: Path) -> dict[str, Any]:
    from formats.mesh import open_edges, read_mesh, signed_volume

    mesh = read_mesh(path, drop_flat_faces=True)
    return {
        "vertices": len(mesh.positions),
        "faces": len(mesh.faces),
        "faces without area": mesh.dropped_faces,
        "vertices merged": 0 if mesh.source_vertex is None else len(mesh.source_vertex) - len(mesh.positions),
        "bounds": mesh.bounds.tolist(),
        "diagonal": mesh.diagonal,
        "open edges": open_edges(mesh),
        "volume": signed_volume(mesh),
        "texture coordinates": mesh.corner_uv is not None,
        "content hash": mesh.content_hash,
    }


def _describe_sky(path: Path) -> dict[str, Any]:
    from formats.image.rows import open_image

    opened = open_image(path)
    largest, infinite, negative, total, count = 0.0, 0, 0, np.zeros(3), np.zeros(3, np.int64)
    for _, block in opened.blocks():
        finite = np.isfinite(block)
        total += block.sum(axis=(0, 1), dtype=np.float64, where=finite)
        count += finite.sum(axis=(0, 1))
        largest = max(largest, float(block.max(where=finite, initial=0)))
        infinite += int((~finite).sum())
        negative += int((block < 0).sum())
    return {
        "width": opened.width,
        "height": opened.height,
        "mean radiance": (total / np.maximum(count, 1)).tolist(),
        "largest radiance": largest,
        "values not finite": infinite,
        "values negative": negative,
    }


def _describe_scene(path: Path) -> dict[str, Any]:
    from formats.scene import read_scene

    scene = read_scene(path)
    tables = [scene.tables.medium, *(table.medium for table in scene.tables.inside)]
    outermost, *others = [
        {**_describe_part(part), **_materials(part, table)} for part, table in zip(scene.parts, tables, strict=True)
    ]
    inside = {
        f"{part.name}: {name}": value
        for part, told in zip(scene.parts[1:], others, strict=True)
        for name, value in {"in": scene.parts[part.parent].name, **told}.items()
    }
    return {
        **outermost,
        "up": scene.up,
        "unit": scene.unit,
        "parts": len(scene.parts),
        **inside,
        "content hash": scene.content_hash,
    }


def _describe_part(part: "Part") -> dict[str, Any]:
    told: dict[str, Any] = {
        "mesh": str(part.mesh_path),
        "vertices": len(part.mesh.positions),
        "faces": len(part.mesh.faces),
        "diagonal": part.mesh.diagonal,
    }
    if part.diffuse is not None:
        return {**told, "reflectance": _constant_or_array(part.diffuse, "texture")}
    assert part.medium is not None
    return {
        **told,
        "eta": part.eta,
        "roughness": _constant_or_array(part.roughness, "texture"),
        "normals": part.normals,
        "energy compensation": part.energy_compensation,
        "sigma_t": _constant_or_array(part.medium.sigma_t, "grid"),
        "albedo": _constant_or_array(part.medium.albedo, "grid"),
        "phase_g": part.medium.phase_g,
    }


def _materials(part: "Part", table: "MediumTable | None") -> dict[str, Any]:
    """The materials that a part's table names, with the index that they were measured with."""
    from formats.scene.materials import find_material

    told = {}
    for key, name in (
        ("material", table and table.material),
        ("mixed with", table and table.mix and table.mix.material),
    ):
        if name:
            material = find_material(name)
            told[key] = f"{material.name}, measured with eta {material.eta:g}; taken is that of the scene, {part.eta:g}"
    return told


def _constant_or_array(quantity: Any, kind: str) -> Any:
    values = np.asarray(quantity)
    if values.ndim < 2:
        return values.tolist()
    return f"{kind} {list(values.shape)}, {values.min():g} to {values.max():g}"


def _describe_model(path: Path) -> dict[str, Any]:
    from prt_bake.network.bssrdf import load_model

    network = load_model(path)
    return {
        "weights": sum(parameter.numel() for parameter in network.parameters()),
        "box minimum": network.box_min.tolist(),
        "box side": network.box_side,
        **_describe_interior(network.view),
        **{f"settings: {name}": value for name, value in network.settings.as_json().items()},
        **network.metadata,
    }


def _describe_interior(view: Any) -> dict[str, Any]:
    if view is None:
        return {}
    told = view.interior.as_json()
    return {f"interior: {name}": told[name] for name in ("places", "spacing", "attenuation", "eta")}


def _describe_importance(path: Path) -> dict[str, Any]:
    from prt_bake.importance.module import read_importance

    module, owner = read_importance(path)
    return {
        "of model": owner,
        "weights": sum(parameter.numel() for parameter in module.parameters()),
        **{f"settings: {name}": value for name, value in module.settings.as_json().items()},
        **module.metadata,
    }


def _describe_asset(path: Path) -> dict[str, Any]:
    from formats.asset import read_asset

    asset = read_asset(path)
    return {
        "vertices": len(asset.mesh.positions),
        "vertices baked": int(np.count_nonzero(asset.valid)),
        "faces": len(asset.mesh.faces),
        "rings": asset.rings,
        "sectors": asset.sectors,
        "degree": asset.degree,
        "coefficients": f"{asset.coefficients.dtype} {list(asset.coefficients.shape)}",
        "complete": bool(asset.complete),
        "up": asset.up,
        "unit": asset.unit,
        "left out": asset.left_out,
        **_describe_compaction(asset.coefficients),
        **{f"provenance: {name}": value for name, value in asset.provenance.items()},
    }


def _describe_compaction(coefficients: Any) -> dict[str, Any]:
    from formats.asset.compact_record import CompactCoefficients

    if not isinstance(coefficients, CompactCoefficients):
        return {}
    added = coefficients.added
    return {
        "compact: components": len(coefficients.view_component),
        "compact: codes a vertex": len(coefficients.values) / len(coefficients),
        "compact: added relative RMSE": added.total,
        "compact: asked for": added.requested,
        "compact: 95th percentile over vertices": added.percentile_95,
        "compact: worst vertex": added.worst,
    }


def _describe_samples(path: Path) -> dict[str, Any]:
    from formats.samples import read_samples

    samples = read_samples(path)
    mean, error = (np.square(values, dtype=np.float64).sum() for values in (samples.mean, samples.standard_error))
    return {
        "queries": len(samples.keys),
        "directions": samples.head.directions,
        "walks a query": samples.head.walks,
        "relative noise": float(np.sqrt(error / max(mean, 1e-300))),
        "complete": samples.complete,
        "scene": samples.head.scene,
        "scene hash": samples.head.scene_hash,
        "unit": samples.head.unit,
        "seed": samples.head.seed,
        **{f"settings: {name}": value for name, value in samples.head.settings.items()},
    }


def _samples_faults(path: Path) -> list[str]:
    from formats.samples import check_samples

    return check_samples(path)


def _sky_faults(path: Path) -> list[str]:
    from formats.image.rows import open_image
    from prt_bake.lights.sky_pixels import checked

    remedy = "repair the picture, or give --mend to `prtbake shade`, `view`, `render` or `light`"
    for _ in checked(open_image(path), remedy).blocks():
        pass
    return []


def _scene_faults(path: Path) -> list[str]:
    from formats.scene import read_scene
    from formats.scene.file import find_table_faults

    faults = find_table_faults(path)
    if not faults:
        read_scene(path)
    return faults


def _model_faults(path: Path) -> list[str]:
    from prt_bake.network.bssrdf import load_model

    load_model(path)
    return []


def _importance_faults(path: Path) -> list[str]:
    from prt_bake.importance.module import load_importance, read_importance

    read_importance(path)
    load_importance(path.with_name(path.stem.removesuffix(".importance") + path.suffix))
    return []


def _mesh_faults(path: Path) -> list[str]:
    from formats.mesh import check_mesh

    return check_mesh(path)


def _asset_faults(path: Path) -> list[str]:
    from formats.asset import check_asset, read_asset
    from prt_bake.inspection.assets import soundness_faults

    return check_asset(path) or [f"{path}: {fault}" for fault in soundness_faults(read_asset(path))]


_DESCRIBE: dict[str, Callable[[Path], dict[str, Any]]] = {
    "mesh": _describe_mesh,
    "sky": _describe_sky,
    "scene": _describe_scene,
    "model": _describe_model,
    "importance": _describe_importance,
    "asset": _describe_asset,
    "samples": _describe_samples,
}
_FIND_FAULTS: dict[str, Callable[[Path], list[str]]] = {
    "mesh": _mesh_faults,
    "sky": _sky_faults,
    "scene": _scene_faults,
    "model": _model_faults,
    "importance": _importance_faults,
    "asset": _asset_faults,
    "samples": _samples_faults,
}
