"""`prtbake compare`: how far an image is from a reference."""

from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.options import AsJson, Exposure


def compare(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help=".exr, .hdr or .png.")],
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="What it should be, of the same size.")],
    mask: Annotated[
        Path | None, typer.Option(metavar="M", help="Picture that is white where it counts.", show_default=False)
    ] = None,
    exposure: Exposure = 0.0,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="P.png", help="Also write image, reference and FLIP side by side.", show_default=False),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print MSE, SSIM (full and quarter size) and FLIP."""
    from formats.errors import QueryError
    from formats.image import read_image
    from prt_bake.comparison import compare as measure
    from prt_bake.report import as_text, write_side_by_side

    ours, theirs = read_image(image), read_image(reference)
    if ours.shape != theirs.shape:
        (h, w), (height, width) = ours.shape[:2], theirs.shape[:2]
        raise QueryError(
            f"{image}: {w}x{h} where {reference} is {width}x{height}; pictures are compared pixel by pixel, so bring "
            "both to one size"
        )
    figures = measure(ours, theirs, None if mask is None else read_image(mask), exposure)
    if picture is not None:
        write_side_by_side(ours, theirs, figures.flip_map, picture, exposure)
    if as_json:
        print(as_text(figures.as_json()))
        return
    for name, value in figures.as_json().items():
        print(f"{name:<13} {value:.6g}")
