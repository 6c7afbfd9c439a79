"""`prtbake export`: writes a scene for Mitsuba 3."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next
from prt_bake.cli.shared.outputs import check_outputs


def export(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene file.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder to write; created if missing.")
    ],
) -> None:
    """Write a scene for Mitsuba 3.

    Writes scene.xml and its meshes, grids and images. The scene is centred at the origin and lit by a constant white
    environment. Render it with `mitsuba FOLDER/scene.xml`.
    """
    refuse_other_kinds({"SCENE": (scene, ("scene",))})
    from formats.scene import read_scene
    from prt_bake.export.mitsuba_xml import exported_files, write_mitsuba_scene

    read = read_scene(scene)
    check_outputs({"--output": exported_files(read, output)}, {"SCENE": scene}, folder=output)
    written = write_mitsuba_scene(read, output)
    print(f"wrote {written}")
    if shutil.which("mitsuba"):
        say_next("mitsuba", written)
