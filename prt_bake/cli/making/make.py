"""`prtbake make`: a scene to an asset and its pictures, in a given time."""

import os
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from formats.errors import MeshError, StorageError
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next_of_asset
from prt_bake.cli.shared.options import within
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say
from prt_bake.cli.start.init import MaterialName, ObjectSize, draft_scene, write_scene

if TYPE_CHECKING:
    from formats.scene import Scene

_USUAL_LIGHT = "the shipped sky and a sun behind the object"
_SUN_BEHIND = {"y": "sun:0.6,0.6,-0.6:2,1.9,1.7:3", "z": "sun:0.6,0.6,0.6:2,1.9,1.7:3"}
"""For each axis that points up: right of, above and behind an object whose front is +z, or -y. Thin parts glow."""


def make(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene; or a mesh, with --material and --size.")],
    folder: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder to write to.")],
    minutes: Annotated[
        float, typer.Option(callback=within(0.0, 1e6), help="Time of everything: training, bake and pictures.")
    ] = 20.0,
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light", metavar="LIGHT", help="Light of the pictures, as of shade; by default a sky and a sun."
        ),
    ] = None,
    material: MaterialName = None,
    size: ObjectSize = None,
    force: Annotated[
        bool, typer.Option("--force", help="Make everything anew; removes the files of an earlier run.")
    ] = False,
) -> None:
    """Train, bake and picture a scene, within a given time.

    Writes the model with its report, the asset, a smaller one, a picture, a turntable, and a summary with the errors
    and the commands. The same command continues after a stop; finished steps are not done again.
    """
    from formats.scene import read_scene
    from prt_bake.cli.making.page import write_page
    from prt_bake.cli.making.record import ASSET, PAGE, Record, all_names
    from prt_bake.cli.making.steps import Steps, figures
    from prt_bake.lights.lighting import read_lighting

    scene.stat()  # a file that is not there is reported before any folder is made
    refuse_other_kinds({"SCENE": (scene, ("scene", "mesh")), "--light": (light, LIGHT)})
    check_outputs({"--output": [folder / name for name in all_names()]}, {"SCENE": scene, "--light": light}, folder)
    path = _scene_file(scene, folder, material, size, force)
    read = read_scene(path)
    _refuse_turned(read)
    lights = light or [str(resources.files("prt_bake.shipped") / "sky.hdr"), _SUN_BEHIND[read.up]]
    read_lighting(lights, read.up, mesh=read.mesh, say=say)
    settings = {
        "scene": path.name,
        "scene_hash": read.content_hash,
        "light": ", ".join(light) if light else _USUAL_LIGHT,
        "minutes": minutes,
    }
    record = Record.open(folder, settings, force)
    Steps(context, record, path, _short(read.mesh_path), lights).run()
    record.figures = figures(folder)
    record.write()
    write_page(record)
    print(f"{folder / PAGE}: error of the coefficients {record.figures['error of the coefficients']}")
    say_next_of_asset(folder / ASSET, "--reflection", lights=light or ())


def _scene_file(scene: Path, folder: Path, material: str | None, size: str | None, force: bool) -> Path:
    """Return the scene; of a mesh, the one in the folder, which is written if it is not there."""
    from formats.mesh import READABLE

    if scene.suffix.lower() not in READABLE:
        if material is not None or size is not None:
            raise typer.BadParameter("--material and --size are for meshes; a scene has its own, in [medium] and unit")
        return scene
    path = folder / f"{scene.stem}.toml"
    if path.exists() and not force:
        _refuse_other_scene(path, scene, material, size)
        say(f"{path}: is there already, and is used; --force writes it anew")
    else:
        write_scene(scene, material, size, path, "y", force)
    return path


def _refuse_other_scene(path: Path, mesh: Path, material: str | None, size: str | None) -> None:
    """Raise StorageError if these options would write another scene; without them it is used as it is."""
    if material is None and size is None:
        return
    if draft_scene(mesh, material, size, path, "y").text() != path.read_text(encoding="utf-8"):
        raise StorageError(
            f"{path}: is another scene than --material and --size ask for; leave them out to use it as it is, add "
            "--force to make everything anew, or choose another folder"
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
