"""`prtbake compare`: how far an image is from a reference."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.options import AsJson, Exposure
from prt_bake.cli.progress import say


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
    """Print MSE, SSIM (full and quarter size) and FLIP.

    Says so where only one of two pictures by `prtbake render` holds unscattered or reflected light.
    """
    from formats.errors import QueryError
    from formats.image import read_image, read_layers
    from prt_bake.comparison import compare as measure
    from prt_bake.report import as_text, write_side_by_side

    layered, layered_reference = read_layers(image), read_layers(reference)
    ours, theirs = layered.image, layered_reference.image
    if ours.shape != theirs.shape:
        (h, w), (height, width) = ours.shape[:2], theirs.shape[:2]
        raise QueryError(
            f"{image}: {w}x{h} where {reference} is {width}x{height}; pictures are compared pixel by pixel, so bring "
            "both to one size"
        )
    contents = [str(each.attributes.get("prtbake.shows", "")) for each in (layered, layered_reference)]
    for words in _unlike(image, reference, *contents):
        say(words)
    figures = measure(ours, theirs, None if mask is None else read_image(mask), exposure)
    if picture is not None:
        write_side_by_side(ours, theirs, figures.flip_map, picture, exposure)
    if as_json:
        print(as_text(figures.as_json()))
        return
    for name, value in figures.as_json().items():
        print(f"{name:<13} {value:.6g}")


def _unlike(image: Path, reference: Path, shows: str, reference_shows: str) -> Iterator[str]:
    """What light only one of two pictures holds, by their words on it; nothing where one of them has none."""
    if not (shows and reference_shows):
        return
    for light, option in (
        ("unscattered light", "--no-unscattered"),
        ("light reflected at the surface", "--no-reflection"),
    ):
        holding = [light in text and f"{light} left out" not in text for text in (shows, reference_shows)]
        if holding[0] != holding[1]:
            held, lacking = (image, reference) if holding[0] else (reference, image)
            yield f"{held} holds {light}, {lacking} does not: it is in the figures ({option} leaves it out)"
