"""The five scenes of the paper's tables: the paper's figures, the files, the cameras and the bake settings."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from formats.errors import QueryError, SceneError
from formats.mesh import Mesh
from formats.scene import Scene, read_scene
from prt_bake.geometry import camera
from prt_bake.geometry.camera import Camera, Visibility, directions

LEAST_SHARE = 0.4
"""Smallest share of the picture that the object should fill."""
_TARGET_SHARE = 0.42
_FRAMING_PIXELS = 128
_NARROWEST = 0.5


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's first table; seconds on a GPU; the paper does not state the size of the pictures."""

    spp: int
    seconds: float
    megabytes: float | None = None
    mse: float | None = None
    ssim: float | None = None
    flip: float | None = None


@dataclass(frozen=True)
class PaperSky:
    """A column of the paper's second table for one scene and sky: pictures of 1920², SSIM at full and quarter size."""

    mse: float
    ssim: float
    ssim_quarter: float
    flip: float


@dataclass(frozen=True)
class BakeSettings:
    """How a scene is baked for SH of degree 2.

    Attributes:
        subdivisions: how often each face is split into four before the bake, to resolve details between vertices.
        rings, sectors: view bins.
        samples: light directions per bin.
    """

    subdivisions: int
    rings: int = 8
    sectors: int = 16
    samples: int = 256


@dataclass(frozen=True)
class PaperScene:
    """A scene of the paper. `files` are paths under `scenes/`; the first one whose meshes exist is used.

    `published` has the second table's figures by model ("net", "neumip", "nerfactor") and sky, for the scenes in it.
    """

    name: str
    title: str
    files: tuple[str, ...]
    bake: BakeSettings
    path_tracing: PaperRow
    net: PaperRow
    harmonics: PaperRow
    published: dict[str, dict[str, PaperSky]] = field(default_factory=dict)


SCENES = (
    PaperScene(
        "grape",
        "Grape",
        ("grape/grape.toml",),
        BakeSettings(subdivisions=1),
        PaperRow(10000, 1846.44),
        PaperRow(256, 2.038, 1.31, 1.6e-4, 0.975, 0.051),
        PaperRow(1, 3.2e-4, 21.1, 2.8e-3, 0.983, 0.082),
        {
            "net": {
                "outdoor": PaperSky(9.28e-5, 0.949, 0.998, 0.0174),
                "indoor": PaperSky(3.11e-4, 0.870, 0.994, 0.0301),
            },
            "neumip": {
                "outdoor": PaperSky(1.82e-4, 0.982, 0.990, 0.0512),
                "indoor": PaperSky(9.81e-4, 0.979, 0.983, 0.160),
            },
            "nerfactor": {
                "outdoor": PaperSky(3.34e-3, 0.886, 0.889, 0.132),
                "indoor": PaperSky(2.84e-3, 0.912, 0.908, 0.137),
            },
        },
    ),
    PaperScene(
        "dragon",
        "Dragon",
        ("dragon/dragon.toml", "dragon/serpent.toml"),
        BakeSettings(subdivisions=1),
        PaperRow(10000, 2412.56),
        PaperRow(256, 1.813, 1.31, 1.4e-5, 0.990, 0.009),
        PaperRow(1, 1.2e-3, 779.6, 6.2e-4, 0.971, 0.045),
    ),
    PaperScene(
        "paperweight",
        "Paperweight",
        ("paperweight/bunny.toml", "paperweight/cow.toml"),
        BakeSettings(subdivisions=2),
        PaperRow(10000, 2503.83),
        PaperRow(256, 3.950, 3.77, 1.1e-3, 0.987, 0.079),
        PaperRow(1, 3.6e-4, 46.1, 3.4e-3, 0.953, 0.115),
        {
            "net": {
                "outdoor": PaperSky(6.91e-4, 0.757, 0.974, 0.0279),
                "indoor": PaperSky(1.15e-3, 0.754, 0.971, 0.0491),
            },
            "neumip": {
                "outdoor": PaperSky(7.40e-4, 0.973, 0.943, 0.0608),
                "indoor": PaperSky(1.95e-3, 0.960, 0.914, 0.0890),
            },
            "nerfactor": {
                "outdoor": PaperSky(9.31e-3, 0.919, 0.803, 0.163),
                "indoor": PaperSky(1.01e-2, 0.914, 0.807, 0.170),
            },
        },
    ),
    PaperScene(
        "drink",
        "Drink with ice",
        ("drink/drink.toml",),
        BakeSettings(subdivisions=2),
        PaperRow(10000, 1496.24),
        PaperRow(256, 3.231, 1.31, 3.0e-4, 0.870, 0.043),
        PaperRow(1, 2.8e-4, 19.2, 1.4e-3, 0.969, 0.070),
    ),
    PaperScene(
        "lucy",
        "Lucy",
        ("lucy/lucy.toml", "lucy/figure.toml"),
        BakeSettings(subdivisions=1),
        PaperRow(10000, 1198.36),
        PaperRow(256, 2.189, 0.65, 4.7e-4, 0.986, 0.035),
        PaperRow(1, 3.7e-4, 64.2, 1.1e-3, 0.984, 0.382),
    ),
)
NAMES = tuple(scene.name for scene in SCENES)
SKIES = {"outdoor": "skies/outdoor.hdr", "indoor": "skies/indoor.hdr"}
"""Paths under `scenes/`; `scenes/skies/LICENSES.md` names their authors."""


def scenes_folder(given: Path | None) -> Path:
    """Return the folder of the paper's scenes, by default the repository's; raises QueryError if it is not there."""
    folder = given or Path(__file__).parents[2] / "scenes"
    if not folder.is_dir():
        raise QueryError(
            f"{folder}: there is no such folder; the paper's scenes are in the folder scenes of the repository, not in "
            "the installed package: give that folder by --scenes"
        )
    return folder


def select_scenes(names: list[str]) -> tuple[PaperScene, ...]:
    """Return the named scenes, by default all, in the paper's order; raises QueryError for unknown names."""
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        raise QueryError(f"--scene: {unknown[0]!r} is not a scene of the paper; expected {', '.join(NAMES)}")
    return tuple(scene for scene in SCENES if not names or scene.name in names)


def open_scene(paper: PaperScene, folder: Path) -> Scene:
    """Read the scene from its files under `folder`: the original if its mesh exists, else the stand-in.

    Raises SceneError if there is no stand-in either, or if the scene is invalid.
    """
    if not (folder / paper.files[-1]).is_file():
        raise SceneError(
            f"{folder / paper.files[-1]}: not found; the paper's scenes are in the folder scenes of the repository: "
            "run the command in a checkout, or give the folder by --scenes"
        )
    for name in paper.files[:-1]:
        if _has_meshes(folder / name):
            return read_scene(folder / name)
    return read_scene(folder / paper.files[-1])


def is_stand_in(paper: PaperScene, scene: Scene) -> bool:
    """Whether the scene is a stand-in for a mesh that the repository may not contain."""
    return len(paper.files) > 1 and Path(scene.path).name == Path(paper.files[-1]).name


def framing_camera(mesh: Mesh, size: int, up: str) -> Camera:
    """Return the camera of size × size pixels whose picture the object fills to 42 %, or which sees all of it.

    The eye is that of the view "three-quarter-back". The field of view is narrowed until the object fills 42 % of the
    picture.
    """
    fitted = camera.fit(mesh, size, size, up=up, view="three-quarter-back")
    visibility = Visibility(mesh)
    if object_share(visibility, fitted) >= _TARGET_SHARE:
        return fitted
    narrow, wide = _NARROWEST, fitted.fov
    while wide - narrow > 1e-3 * wide:
        middle = 0.5 * (narrow + wide)
        if object_share(visibility, _with_fov(fitted, middle, size)) >= _TARGET_SHARE:
            narrow = middle
        else:
            wide = middle
    return _with_fov(fitted, narrow, size)


def object_share(visibility: Visibility, view: Camera) -> float:
    """Return the share of the picture that the object fills, from 128 × 128 rays."""
    small = _with_fov(view, view.fov, _FRAMING_PIXELS)
    rays = directions(small, slice(0, _FRAMING_PIXELS), np.array([[0.5, 0.5]])).reshape(-1, 3)
    return float((visibility.first_hits(small.eye, rays).faces >= 0).mean())


def _with_fov(view: Camera, fov: float, size: int) -> Camera:
    return Camera(view.eye, view.target, view.up, fov, size, size)


def _has_meshes(path: Path) -> bool:
    """Whether the scans that a scene file names exist; they are the only files that are never committed."""
    if not path.is_file():
        return False
    tokens = path.read_text(encoding="utf-8").replace('"', " ").split()
    scans = {token for token in tokens if token.startswith("stanford_") and token.endswith(".ply")}
    return all((path.parent / scan).is_file() for scan in scans)
