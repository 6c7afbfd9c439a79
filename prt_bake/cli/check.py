"""`prtbake check`: lists the faults of a file."""

from pathlib import Path
from typing import Annotated

import typer

from formats.errors import FormatError
from prt_bake.cli.shared.next_step import say_next_of_file


def check(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Mesh, picture, scene, lights, model, importance module, ONNX function, asset or samples.",
        ),
    ],
) -> None:
    """Print every fault of a file.

    Prints one line per fault; the exit code is 1 if there is any. Remarks name what is allowed but probably unintended,
    and leave the exit code 0.
    """
    from prt_bake.inspection.files import find_faults, find_remarks, kind_of

    faults = find_faults(file)
    for fault in faults:
        print(fault)
    if faults:
        raise FormatError(f"{file}: {len(faults)} {'fault' if len(faults) == 1 else 'faults'} found")
    for remark in find_remarks(file):
        print(f"remark: {remark}")
    print(f"{file}: sound")
    say_next_of_file(kind_of(file), file)
