"""`prtbake export`: writes a scene for Mitsuba 3."""

from pathlib import Path
from typing import Annotated

import typer


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
    from formats.atomic import storage_error
    from formats.errors import StorageError
    from formats.scene import read_scene
    from prt_bake.export.mitsuba_xml import write_mitsuba_scene

    read = read_scene(scene)
    if output.exists() and not output.is_dir():
        raise StorageError(f"{output}: expected a folder, found a file; choose another --output")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise storage_error(output, cause) from cause
    print(f"wrote {write_mitsuba_scene(read, output)}")
