"""`prtbake export`: a scene for another renderer."""

from pathlib import Path
from typing import Annotated

import typer


def export(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene file.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder to write; made if it is not there.")
    ],
) -> None:
    """Write a scene for Mitsuba 3: scene.xml, and the meshes, grids and images it names.

    The middle of the object's bounding box is at the origin, and a white sky shines. Mitsuba renders it by itself:
    `mitsuba FOLDER/scene.xml`.
    """
    from formats.atomic import storage_error
    from formats.errors import StorageError
    from formats.scene import read_scene
    from prt_bake.export.mitsuba_xml import write_mitsuba_scene

    read = read_scene(scene)
    if output.exists() and not output.is_dir():
        raise StorageError(f"{output}: cannot be written: it is a file; give the name of a folder")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise storage_error(output, cause) from cause
    print(f"wrote {write_mitsuba_scene(read, output)}")
