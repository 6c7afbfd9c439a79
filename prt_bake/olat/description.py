"""`dataset.json` and `README.md` of a test set: what its pictures are, in which units, made how, and how noisy."""

import json
from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.errors import FormatError, StorageError
from formats.json_report import write_report
from formats.scene import Scene
from formats.version import program_version
from prt_bake.olat.pictures import SETS, Coordinates, Picture
from prt_bake.olat.settings import IRRADIANCE, OlatSettings
from prt_bake.olat.transforms import DISTANCE

NAME = "dataset.json"
FORMAT = "prtbake-olat"
_METHOD = 1
"""Version of cameras, lights and seeds; a folder of another version is not continued."""


def identity(scene: Scene, settings: OlatSettings, pictures: list[Picture]) -> dict[str, Any]:
    """Everything that the pictures depend on."""
    skies = {each.sky: each.lighting.content_hash() for each in pictures if each.sky is not None}
    return {"method": _METHOD, "scene": scene.content_hash, "up": scene.up, "skies": skies, **settings.as_json()}


def claim(folder: Path, wanted: dict[str, Any]) -> None:
    """Check that a folder is new or holds pictures of the identity `wanted`.

    Raises StorageError for a folder with other files, and FormatError for a test set of another scene or settings.
    """
    if not (folder / NAME).exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise StorageError(f"{folder}: expected a new or empty folder, found other files; choose another folder")
        return
    found = read_dataset(folder)["identity"]
    differing = [name for name in wanted if found.get(name) != wanted[name]]
    if differing:
        name = differing[0]
        what = "another scene" if name == "scene" else f"{name} {found.get(name)}"
        raise FormatError(
            f"{folder}: holds a test set of {what}{'' if name == 'scene' else f', not {wanted[name]}'}; choose another "
            "folder, or the same scene and options to continue it"
        )


def read_dataset(folder: Path) -> dict[str, Any]:
    """The content of `dataset.json`. Raises FormatError if it is missing, damaged or of another kind."""
    path = folder / NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as cause:
        raise FormatError(
            f"{folder}: expected the folder of a test set with {NAME}, found none; make one: prtbake sample SCENE.toml "
            f"--olat -o {folder}"
        ) from cause
    except (OSError, ValueError) as cause:
        raise FormatError(f"{path}: cannot be read: {cause}; make the test set again") from cause
    if (
        not isinstance(content, dict)
        or content.get("format") != FORMAT
        or not isinstance(content.get("identity"), dict)
    ):
        raise FormatError(f"{path}: expected a test set, format {FORMAT!r}, found another file; check the folder")
    return content


def write_dataset(
    folder: Path,
    scene: Scene,
    settings: OlatSettings,
    coordinates: Coordinates,
    shown: dict[str, Any],
    wanted: dict[str, Any],
) -> None:
    """Write `dataset.json` and `README.md`; `shown` describes the finished pictures."""
    report = {
        "format": FORMAT,
        "generator": f"prtbake {program_version()}",
        "scene": scene.path.name,
        **shown,
        "colour": "linear Rec.709; .exr: radiance, premultiplied by the coverage A; .png: sRGB curve, straight alpha",
        "layers": "error.R, error.G, error.B: standard error of each pixel and channel, independent between pixels",
        "light": {
            "kind": "directional" if settings.light_diameter == 0.0 else "disc at infinity",
            "irradiance": IRRADIANCE,
            "angular_diameter": settings.light_diameter,
            "pl_pos_distance": DISTANCE,
        },
        "skies": "lat-long, z up, mean radiance 1 over the sphere",
        "coordinates": {**coordinates.as_json(), "scene_unit": scene.unit},
        "licence": f"pictures of {scene.path.name}: that of its mesh and textures; skies: that of their files",
        "identity": wanted,
    }
    write_report(report, folder / NAME)
    with replacing(folder / "README.md") as part:
        part.write_text(_readme(folder, scene, settings, shown), encoding="utf-8")


def _readme(folder: Path, scene: Scene, settings: OlatSettings, shown: dict[str, Any]) -> str:
    counts = ", ".join(f"{name} {len([p for p in shown['pictures'] if p.startswith(f'{name}/')])}" for name in SETS)
    state = "" if shown["complete"] else "\nThe set is not finished: the same command continues it.\n"
    light = "One distant light" if settings.light_diameter == 0.0 else f"A disc of {settings.light_diameter:g}°"
    version, size = program_version(), f"{settings.width}x{settings.height}"
    return f"""# {scene.path.stem}: one light at a time
{state}
Path-traced pictures by prtbake {version}, {size} pixels, {settings.spp} paths a pixel: {counts}.
They show {shown["shows"]}.

| file | content |
|---|---|
| `transforms_train.json`, `transforms_test.json` | cameras and lights; the test set has others than the training set |
| `transforms_held_out_skies.json` | the test cameras under skies; `environment` names the sky |
| `*.exr` | linear radiance R, G, B, coverage A, standard error error.R, error.G, error.B |
| `*.png` | the same as sRGB, clipped at 1, with straight alpha |
| `dataset.json` | settings, seeds, coordinates, noise of each picture |

* **Light.** {light} of irradiance {IRRADIANCE:.4f} in each channel, measured perpendicular to `light_direction`, which
  points to the light. A white Lambertian surface that faces it has radiance 1. `pl_pos` is a point {DISTANCE:g} lengths
  away, and `pl_intensity` = irradiance · {DISTANCE:g}² gives the same irradiance at the origin.
* **Coordinates.** Right-handed, z up; the object's longest side is 1, the centre of its box the origin.
  `scene_to_dataset` in `dataset.json` leads there from the scene's. `transform_matrix` is camera to world, OpenGL axes.
* **Skies.** Lat-long pictures, mean radiance 1. A pixel at u, v in [0,1] shows the direction
  (cosφ sinθ, −sinφ sinθ, cosθ), φ = 2π(u − ½), θ = πv.
* **Alpha.** Colours of .exr are premultiplied by A. Readers that multiply them by A again darken the outline.
* **Licence.** That of the scene's mesh and textures, and of the sky files.

Write predictions as .exr (or .png) under the same names, `test/…` and `held_out_skies/…`, in another folder, and score
them:

    prtbake compare PREDICTED {folder.name} --json
"""
