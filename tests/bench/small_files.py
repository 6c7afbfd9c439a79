"""Small valid files of every kind that is read, and their readers, for `tests.bench.faults`."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from formats.asset import read_asset, write_asset
from formats.asset.lobes import Lobes
from formats.image import read_image, write_image
from formats.image.rows import open_image
from formats.journal import Journal
from formats.mesh import build_mesh, read_mesh, write_mesh
from formats.samples import read_samples
from formats.scene import read_scene
from formats.scene.grid import read_grid
from prt_bake.network.bssrdf import NeuralBSSRDF, load_model, save_model
from prt_bake.rendering.state import Sums, read_checkpoint, write_checkpoint
from tests.formats.asset.test_asset import make_asset
from tests.formats.asset.test_compact import compact_asset
from tests.formats.mesh.gltf_files import tetrahedron
from tests.formats.samples.test_samples import block
from tests.formats.samples.test_samples import write as write_samples
from tests.shapes import ball

Read = Callable[[Path], object]
Make = Callable[[Path], list[Path]]

_SCENE = """[object]
mesh = "ball.ply"
unit = "cm"
[interface]
eta = 1.4
roughness = 0.2
[medium]
sigma_t = [4.0, 5.0, 6.0]
albedo = 0.9
[[inside]]
name = "seed"
mesh = "seed.ply"
surface = "diffuse"
reflectance = [0.5, 0.4, 0.3]
"""
_POLYGONS = "# box\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\nvt 0.5 0.5\nvn 0 0 1\n" + (
    "f 4/1 3/1 2/1 1/1\nf 5/1 6/1 7/1 8/1\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
)
_PICTURE = np.random.default_rng(0).exponential(size=(8, 16, 3)).astype(np.float32)


def _meshes(suffix: str) -> Make:
    def make(folder: Path) -> list[Path]:
        paths = [folder / f"{name}{suffix}" for name in ("ball", "text")]
        solid = trimesh.creation.box()
        if suffix == ".stl":
            paths[0].write_bytes(trimesh.exchange.stl.export_stl(solid))
            paths[1].write_text(trimesh.exchange.stl.export_stl_ascii(solid))
            return paths
        write_mesh(ball(1), paths[0])
        paths[1].write_bytes(
            _POLYGONS.encode() if suffix == ".obj" else trimesh.exchange.ply.export_ply(solid, encoding="ascii")
        )
        return paths

    return make


def _gltf(suffix: str) -> Make:
    return lambda folder: [tetrahedron().write(folder / f"solid{suffix}")]


def _picture(suffix: str) -> Make:
    def make(folder: Path) -> list[Path]:
        path = folder / f"picture{suffix}"
        if suffix == ".jpg":
            Image.fromarray((255 * np.clip(_PICTURE, 0, 1)).astype(np.uint8)).save(path)
        elif suffix == ".exr":
            write_image(path, _PICTURE, layers={"error": _PICTURE, "coverage": _PICTURE[..., 0]})
        else:
            write_image(path, _PICTURE)
        return [path]

    return make


def _scene(folder: Path) -> list[Path]:
    write_mesh(ball(1), folder / "ball.ply")
    write_mesh(build_mesh(0.3 * ball(1).positions, ball(1).faces), folder / "seed.ply")
    (folder / "scene.toml").write_text(_SCENE)
    return [folder / "scene.toml"]


def _grid(folder: Path) -> list[Path]:
    np.save(folder / "grid.npy", np.ones((3, 4, 5, 3)))
    return [folder / "grid.npy"]


def _model(suffix: str) -> Make:
    def make(folder: Path) -> list[Path]:
        save_model(NeuralBSSRDF(box_min=(-1.0, -1.0, -1.0), box_side=2.0), folder / f"model{suffix}")
        return [folder / f"model{suffix}"]

    return make


def _asset(folder: Path) -> list[Path]:
    asset = make_asset()
    shape = len(asset.valid), 1, 2
    axes = np.broadcast_to(np.float32([0.0, 0.6, 0.8]), (*shape, 3))
    lobes = Lobes(1, 1, axes, np.full(shape, 9.0, np.float32), np.ones((*shape, 3), np.float32))
    write_asset(asset, folder / "asset.h5")
    write_asset(replace(asset, lobes=lobes), folder / "lobed.h5")
    return [folder / "asset.h5", folder / "lobed.h5"]


def _compact(folder: Path) -> list[Path]:
    write_asset(compact_asset(), folder / "compact.h5")
    return [folder / "compact.h5"]


def _samples(folder: Path) -> list[Path]:
    write_samples(folder / "samples.h5", [block(5, 3)])
    return [folder / "samples.h5"]


def _block(folder: Path) -> list[Path]:
    with Journal(folder / "out.h5", {"seed": 1}, resume=False) as journal:
        journal.write("block", {"values": np.arange(24.0), "done": np.array([1])})
        shutil.copy(journal.folder / "block.npz", folder / "block.npz")
    return [folder / "block.npz"]


def _read_twice(path: Path) -> object:
    """Read a picture in one piece, then in blocks of rows, as skies are."""
    return read_image(path), open_image(path).read()


def _read_block(path: Path) -> object:
    with Journal(path.parent / "out.h5", {"seed": 1}, resume=True) as journal:
        shutil.copy(path, journal.folder / "block.npz")
        return journal.read("block")


def _render(folder: Path) -> list[Path]:
    sums = Sums.empty(4, 4)
    sums.passes = 2
    write_checkpoint(folder / "picture.render.npz", sums, {"seed": 1}, {})
    return [folder / "picture.render.npz"]


KINDS: dict[str, tuple[Make, Read]] = {
    **{suffix[1:]: (_meshes(suffix), read_mesh) for suffix in (".obj", ".ply", ".stl")},
    **{suffix[1:]: (_gltf(suffix), read_mesh) for suffix in (".glb", ".gltf")},
    **{suffix[1:]: (_picture(suffix), _read_twice) for suffix in (".exr", ".hdr", ".png", ".jpg")},
    "toml": (_scene, read_scene),
    "npy": (_grid, lambda path: read_grid(path.parent / "scene.toml", "sigma_t", path.name, 1e9)),
    "pt": (_model(".pt"), load_model),
    "safetensors": (_model(".safetensors"), load_model),
    "asset": (_asset, read_asset),
    "compact": (_compact, read_asset),
    "samples": (_samples, read_samples),
    "journal": (_block, _read_block),
    "render": (_render, lambda path: read_checkpoint(path, {"seed": 1})),
}
"""How the valid files of a kind are made in a folder, and how one is read."""
