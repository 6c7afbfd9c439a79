"""`prtbake example`: copies the shipped scene, mesh, model and sky into a new folder."""

from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.shared.next_step import say_next
from prt_bake.cli.shared.outputs import check_outputs


def example(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to create.")],
) -> None:
    """Copy the shipped scene, mesh, model and sky into a new folder.

    The scene is a cow of veined marble, and the model was trained on it. `prtbake bake` may begin with the model at
    once.
    """
    from prt_bake.shipped.examples import NAMES, copy_examples

    check_outputs({"DIR": [folder / name for name in NAMES]}, {}, folder=folder)
    for path in copy_examples(folder):
        print(path)
    say_next("cd", folder)
    say_next("prtbake", "bake", "spot.pt", "spot.obj", "-o", "spot.h5")
    say_next("prtbake", "shade", "spot.h5", "--light", "sky.hdr", "--reflection", "-o", "spot.png")
    say_next("prtbake", "train", "spot.toml", "-o", "marble.pt", "--minutes", "10")
