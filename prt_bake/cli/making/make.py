"""`prtbake make`: a scene to an asset and its pictures, in a given time."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from formats.atomic import sha256
from formats.errors import MeshError, SceneError, StorageError
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next_of_asset
from prt_bake.cli.shared.options import Exposure, ToneMap, View
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say
from prt_bake.cli.start.init import MaterialName, ObjectSize, UpAxis, draft_scene, write_draft

if TYPE_CHECKING:
    from formats.scene import Scene
    from prt_bake.cli.start.scene_draft import SceneDraft

_LEAST_MINUTES = 2.0
"""What the least of every step takes on two cores, for some thousand vertices."""
_USUAL_LIGHT = "the shipped sky and a sun behind the object"
_SUN_BEHIND = {"y": "sun:0.6,0.6,-0.6:2,1.9,1.7:3", "z": "sun:0.6,0.6,0.6:2,1.9,1.7:3"}
"""For each axis that points up: right of, above and behind an object whose front is +z, or -y. Thin parts glow."""


def _enough(minutes: float | None) -> float | None:
    """Refuse a time that the steps cannot keep."""
    if minutes is not None and not _LEAST_MINUTES <= minutes <= 1e6:
        raise typer.BadParameter(
            f"found {minutes:g}; training, bake and pictures take {_LEAST_MINUTES:g} minutes at least, or more with a "
            "large mesh; 20 are usual"
        )
    return minutes


def make(
    context: typer.Context,
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE",
            help="Mesh (.glb, .gltf, .obj, .ply, .stl) with --material and --size; or a scene (.toml).",
        ),
    ],
    folder: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder to write to.")],
    minutes: Annotated[
        float | None,
        typer.Option(
            callback=_enough,
            help="Time of all runs in the folder together, 2 or more; by default 20, or what the folder has. With "
            "twice as much the training goes on; with less than that, only what was left out is made.",
            show_default=False,
        ),
    ] = None,
    material: MaterialName = None,
    size: ObjectSize = None,
    start: Annotated[
        Path | None,
        typer.Option("--from", metavar="EARLIER.pt", help="Start from a model of the object, as of train."),
    ] = None,
    up: UpAxis = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light", metavar="LIGHT", help="Light of the pictures, as of shade; by default a sky and a sun."
        ),
    ] = None,
    side: View = None,
    exposure: Exposure = 0.0,
    tone_map: ToneMap = "agx",
    force: Annotated[
        bool, typer.Option("--force", help="Make everything again; removes the files of an earlier run.")
    ] = False,
) -> None:
    """Train, bake and render an object, within a given time.

    For example: `prtbake make skull.glb -o skull --material jade --size 14cm`

    Writes the model with its report, the asset, a smaller one, a picture, a turntable, and a summary with the errors
    and the commands. The same command continues after a stop; finished steps are not done again.
    """
    from prt_bake.cli.making.page import results, write_page
    from prt_bake.cli.making.record import ASSET, Record, all_names, only_run, refuse_foreign
    from prt_bake.cli.making.steps import Steps, figures
    from prt_bake.inspection.scene import appearance_remark

    scene.stat()  # a file that is not there is reported before any folder is made
    refuse_other_kinds({"SCENE": (scene, ("scene", "mesh")), "--light": (light, LIGHT), "--from": (start, ("model",))})
    path, draft = _scene_file(scene, folder, material, size, up, force)
    lights = _lights(light, draft or _read(path))
    inputs = {"SCENE": scene, "--light": light, "--from": start}
    check_outputs({"--output": [folder / name for name in all_names()]}, inputs, folder)
    with only_run(folder):
        if draft is not None:
            if not force:
                refuse_foreign(folder)
            write_draft(draft)
        read = _read(path)
        if remark := appearance_remark(read):
            say(f"remark: {path}: {remark}")
        settings = {
            "scene": path.name,
            "scene_hash": read.content_hash,
            "keys": _keys(read),
            "start_hash": None if start is None else sha256(start),
        }
        options = ["--tone-map", tone_map, *(["--exposure", f"{exposure:g}"] if exposure else [])]
        options += ["--view", side] if side else []
        files = [sha256(name) for name in light or () if Path(name).is_file()]
        pictures = {"light": ", ".join(light) if light else _USUAL_LIGHT, "light_files": files, "options": options}
        record = Record.open(folder, settings, pictures, minutes, force)
        Steps(context, record, path, _short(read.mesh_path), lights, start).run()
        record.figures = figures(folder)
        record.write()
        write_page(record)
    print("\n".join(results(record)))
    say_next_of_asset(folder / ASSET, "--reflection", *options, lights=light or ())


def _scene_file(
    scene: Path,
    folder: Path,
    material: str | None,
    size: str | None,
    up: Literal["y", "z"] | None,
    force: bool,
) -> tuple[Path, "SceneDraft | None"]:
    """Return the scene, and its draft if it is that of a mesh and is not yet in the folder."""
    from formats.mesh import READABLE

    if scene.suffix.lower() not in READABLE:
        if (material, size, up) != (None, None, None):
            raise typer.BadParameter("--material, --size and --up are for meshes; a scene has its own")
        return scene, None
    path = folder / f"{scene.stem}.toml"
    if path.exists() and not force:
        _refuse_other_scene(path, scene, material, size, up)
        say(f"{path}: is there already, and is used; --force writes it again")
        return path, None
    draft = draft_scene(scene, material, size, path, up)
    if size is None:
        _refuse_opaque(draft)
    return path, draft


def _refuse_opaque(draft: "SceneDraft") -> None:
    """Raise typer.BadParameter if an object whose size nobody has given would look like stone."""
    if not draft.light.opaque:
        return
    from prt_bake.inspection.translucency import translucent_size

    name = draft.material.name
    raise typer.BadParameter(
        f"{draft.mesh_path}: at {draft.light.size:.4g} mm, no light crosses {name}, and the object would look like "
        f"stone; add its size, such as --size {translucent_size(draft.light)} "
        f"(--size {draft.light.size:.4g}mm keeps it)"
    )


def _lights(light: list[str] | None, shown: "Scene | SceneDraft") -> list[str]:
    """Return the lights of the pictures, which can be read."""
    from prt_bake.lights.lighting import read_lighting
    from prt_bake.shipped.examples import example

    lights = light or [str(example("sky.hdr")), _SUN_BEHIND[shown.up]]
    read_lighting(lights, shown.up, mesh=shown.mesh, say=say)
    return lights


def _read(path: Path) -> "Scene":
    from formats.scene import read_scene

    scene = read_scene(path)
    _refuse_turned(scene)
    return scene


def _keys(scene: "Scene") -> dict[str, Any]:
    """The keys of a scene file as they are written, and its axis, by names such as "medium.density"."""
    from formats.scene.toml import read_toml

    tables = read_toml(scene.path, SceneError, "a scene file")
    written = {
        name if key is None else f"{name}.{key}": value
        for name, table in tables.items()
        for key, value in (table.items() if isinstance(table, dict) else [(None, table)])
    }
    return {**written, "object.up": scene.up}


def _refuse_other_scene(
    path: Path, mesh: Path, material: str | None, size: str | None, up: Literal["y", "z"] | None
) -> None:
    """Raise StorageError if these options would write another scene; without them it is used as it is."""
    if (material, size, up) == (None, None, None):
        return
    if draft_scene(mesh, material, size, path, up).text() != path.read_text(encoding="utf-8"):
        raise StorageError(
            f"{path}: is another scene than --material, --size and --up ask for; leave them out to use it as it is, "
            "add --force to make everything again, or choose another folder"
        )


def _short(path: Path) -> Path:
    """Return the shorter of the absolute path and the one from the current folder."""
    try:
        return min(Path(os.path.relpath(path.resolve())), path.resolve(), key=lambda name: len(str(name)))
    except ValueError:  # another drive
        return path.resolve()


def _refuse_turned(scene: "Scene") -> None:
    """Raise MeshError, before the training, for the mesh that a bake refuses and a scene turns."""
    if scene.flipped:
        raise MeshError(f"{scene.mesh_path}: the faces are wound inside out; flip the normals in a mesh editor")
