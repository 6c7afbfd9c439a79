"""SH of degree 2: a scene's network baked to an asset, and the asset's picture."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from formats.asset import read_asset
from formats.image import write_image
from formats.mesh import Mesh, build_mesh
from prt_bake.baking.bake import bake
from prt_bake.geometry.camera import Camera
from prt_bake.lights.lighting import Sky
from prt_bake.network.bssrdf import load_model
from prt_bake.paper.artefacts import Artefact, Facts, Stopped
from prt_bake.paper.scenes import BakeSettings
from prt_bake.shading.picture import render_picture

DEGREE = 2
_RAYS_PER_PIXEL_SIDE = 4


def subdivided(mesh: Mesh, subdivisions: int) -> Mesh:
    """Return the mesh with each face split into four, `subdivisions` times; the surface is unchanged."""
    from trimesh import remesh

    subdivide: Any = remesh.subdivide
    positions, faces = np.asarray(mesh.positions), np.asarray(mesh.faces)
    for _ in range(subdivisions):
        positions, faces = subdivide(positions, faces)
    return build_mesh(positions, faces) if subdivisions else mesh


def bake_asset(
    path: Path,
    model: Artefact,
    mesh: Mesh,
    settings: BakeSettings,
    stop: Callable[[], bool],
    progress: Callable[[float], None],
) -> Facts:
    """Bake a model at degree 2 into the file `path`; return seconds, vertices, bins and the estimated projection error.

    Raises Stopped if a stop was requested.
    """
    asset = bake(
        load_model(model.path),
        subdivided(mesh, settings.subdivisions),
        DEGREE,
        settings.rings,
        settings.sectors,
        samples=settings.samples,
        out=path,
        workers=os.cpu_count() or 1,
        progress=lambda done, total, row: progress(done / total),
        stop=stop,
        provenance={"command": "prtbake report paper", "source": model.path.name, "source_sha256": model.sha256},
    )
    if not asset.complete:
        raise Stopped(f"{path}: the bake was stopped; the same command bakes it again")
    report = asset.provenance
    return {
        "seconds": report["seconds"],
        "vertices": len(asset.mesh.positions),
        "bins": settings.rings * settings.sectors,
        "projection_error": report["estimated_relative_rmse"]["total"],
    }


def shade_asset_picture(path: Path, asset: Artefact, sky: Sky, view: Camera) -> Facts:
    """Shade the asset under a sky into an .exr of its subsurface light alone; return seconds and counts."""
    picture = render_picture(
        read_asset(asset.path), sky.image, view, up=sky.up, samples=_RAYS_PER_PIXEL_SIDE, background=False
    )
    write_image(path, picture.image, layers={"coverage": picture.coverage})
    return {"seconds": picture.seconds, "clamped": picture.clamped, "vertices_shaded": picture.shaded}
