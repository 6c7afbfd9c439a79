"""`prtbake compare`: how far an image is from a reference."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from prt_bake.cli.shared.bounds import Bounds, FailAbove, FailBelow
from prt_bake.cli.shared.options import AsJson, Exposure, optional_output
from prt_bake.cli.shared.progress import say

if TYPE_CHECKING:
    from formats.image.exr import Layers
    from prt_bake.comparison.noise import PixelErrors
    from prt_bake.comparison.noise_free import NoiseFree

_MAPS = (".png", ".exr")


def _read_range(text: str | tuple[float, float]) -> tuple[float, float]:
    if isinstance(text, tuple):
        return text
    try:
        start, stop = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not START,STOP in stops, such as -4,2") from None
    return start, stop


def compare(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help=".exr, .hdr, .png or .jpg.")],
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="What it should be, of the same size.")],
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="M",
            help="Picture that is white, or opaque where it has an alpha, where pixels count.",
            show_default=False,
        ),
    ] = None,
    exposure: Exposure = 0.0,
    hdr_exposures: Annotated[
        Any,
        typer.Option(
            parser=_read_range,
            metavar="START,STOP",
            help="Stops that HDR-FLIP looks at, after --exposure; by default those of its paper for the reference.",
            show_default=False,
        ),
    ] = None,
    keep_noise: Annotated[
        bool, typer.Option("--keep-noise", help="Do not estimate the figures without the noise of error layers.")
    ] = False,
    picture: Annotated[
        Path | None,
        optional_output(
            "--picture --sheet",
            "P.png",
            "Also write image, reference, signed difference, FLIP and HDR-FLIP side by side, with scales and figures.",
            ".png",
        ),
    ] = None,
    difference_map: Annotated[
        Path | None,
        optional_output("--difference-map", "D.png", "Also write image − reference (.exr: numbers).", *_MAPS),
    ] = None,
    flip_map: Annotated[
        Path | None, optional_output("--flip-map", "F.png", "Also write the map of FLIP (.exr: numbers).", *_MAPS)
    ] = None,
    hdr_flip_map: Annotated[
        Path | None,
        optional_output("--hdr-flip-map", "F.png", "Also write the map of HDR-FLIP (.exr: numbers).", *_MAPS),
    ] = None,
    fail_above: FailAbove = None,
    fail_below: FailBelow = None,
    as_json: AsJson = False,
) -> None:
    """Print MSE, relative MSE and RMSE, SSIM (full and quarter size), FLIP and HDR-FLIP.

    Where pictures have an error layer, as those of `prtbake render` and `prtbake shade` (.exr), the figures are also
    estimated as they would be without that noise, each with the interval that holds it 95 times in 100. Says so where
    only one of two pictures by `prtbake render` holds unscattered or reflected light. Pixels that are transparent in
    both pictures do not count.
    """
    from formats.image import read_layers
    from formats.json_report import as_text
    from prt_bake.comparison import sheet
    from prt_bake.comparison.alpha import weighted
    from prt_bake.comparison.metrics import checked
    from prt_bake.comparison.metrics import compare as measure

    bounds = Bounds.of(fail_above or [], fail_below or [])
    layered, layered_reference = (weighted(path, read_layers(path)) for path in (image, reference))
    ours, theirs = layered.image, layered_reference.image
    chosen = None if mask is None else _read_mask(mask)
    _refuse_other_sizes(image, ours, (reference, theirs), *([] if chosen is None else [(mask, chosen)]))
    for words in _remarks(image, reference, layered, layered_reference):
        say(words)
    if chosen is None:
        chosen = _mask_by_alpha(image, reference, layered, layered_reference)
    names = (str(image), str(reference), str(mask))
    found = measure(ours, theirs, chosen, exposure, hdr=True if hdr_exposures is None else hdr_exposures, names=names)
    errors = None if keep_noise else _errors(image, reference, layered, layered_reference)
    without = None if errors is None else _without_noise(ours, theirs, errors, chosen, exposure, found.hdr_exposures)
    lifted, target, counts = checked(ours, theirs, chosen, exposure)
    if picture is not None:
        intervals = None if without is None else without.figures
        dimmed = None if chosen is None else counts
        sheet.write_sheet(picture, ours, theirs, found, (image.name, reference.name), exposure, dimmed, intervals)
    if difference_map is not None:
        sheet.write_difference_map(difference_map, lifted - target)
    for path, values in ((flip_map, found.flip_map), (hdr_flip_map, found.hdr_flip_map)):
        if path is not None and values is not None:
            sheet.write_flip_map(path, values)
    told = {**found.as_json(), "pixels": int(counts.sum()), "exposure": exposure}
    if without is not None:
        told["noise_free"] = without.as_json()
    if as_json:
        print(as_text(told))
    else:
        for line in _lines(told):
            print(line)
    bounds.hold(image, told)


def _refuse_other_sizes(image: Path, pixels: Any, *others: Any) -> None:
    from formats.errors import QueryError

    h, w = pixels.shape[:2]
    for path, found in others:
        if found.shape[:2] != (h, w):
            height, width = found.shape[:2]
            raise QueryError(
                f"{image}: {w}x{h} where {path} is {width}x{height}; pictures are compared pixel by pixel, so bring "
                "both to one size"
            )


def _read_mask(path: Path) -> Any:
    """The mask of a picture: its alpha where it has one, else its colour."""
    from formats.image import read_layers
    from prt_bake.comparison.alpha import alpha_of

    picture = read_layers(path)
    alpha = alpha_of(picture)
    if alpha is None:
        return picture.image
    say(f"{path}: its alpha channel is the mask; what is opaque counts")
    return alpha


def _mask_by_alpha(image: Path, reference: Path, layered: "Layers", layered_reference: "Layers") -> Any:
    """The pixels that show something, where both pictures are transparent in some; says what is done with an alpha."""
    from prt_bake.comparison.alpha import alpha_of, seen_in_either

    seen = seen_in_either(layered, layered_reference)
    if seen is not None:
        say(f"{(~seen).sum()} of {seen.size} pixels are transparent in both pictures, and do not count")
        return seen
    for path, picture in ((image, layered), (reference, layered_reference)):
        if alpha_of(picture) is not None:
            say(
                f"{path}: its alpha channel is left out: what is transparent is black, and counts; --mask {path} "
                "counts what is opaque alone"
            )
    return None


def _remarks(image: Path, reference: Path, layered: "Layers", layered_reference: "Layers") -> Iterator[str]:
    contents = [str(each.attributes.get("prtbake.shows", "")) for each in (layered, layered_reference)]
    yield from _unlike(image, reference, *contents)
    for path, pixels in ((image, layered.image), (reference, layered_reference.image)):
        negative = int((pixels < 0.0).any(axis=2).sum())
        if negative:
            yield f"{path}: {negative} of {pixels[..., 0].size} pixels hold negative radiance, seen as black"


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


def _errors(image: Path, reference: Path, layered: "Layers", layered_reference: "Layers") -> "PixelErrors | None":
    """What the pictures say of their errors; None, with a word, where that cannot be used."""
    import numpy as np

    from prt_bake.comparison.noise import errors_of, same_numbers, unusable

    reasons = [unusable(path, each) for path, each in ((image, layered), (reference, layered_reference))]
    for reason in filter(None, reasons):
        say(reason)
    errors = None if any(reasons) else errors_of(layered, layered_reference)
    if errors is not None and np.array_equal(layered.image, layered_reference.image):
        say(f"{image} and {reference} are the same picture: there is no noise to take out")
        return None
    if errors is not None and same_numbers(layered, layered_reference):
        say(
            f"{image} and {reference} were drawn from the same random numbers, so that their noise is alike and cannot "
            "be taken out; render one of them with another --seed"
        )
        return None
    if errors is not None and errors.shared.any():
        say(
            "the error that a bake has left is alike in neighbouring pixels: it is taken out of squared differences "
            "alone, their intervals are wider for it, and FLIP and SSIM keep it"
        )
    return errors


def _without_noise(
    ours: Any, theirs: Any, errors: "PixelErrors", mask: Any, exposure: float, exposures: Any
) -> "NoiseFree":
    from prt_bake.comparison.noise_free import compare_without_noise

    found = compare_without_noise(ours, theirs, errors, mask, exposure, hdr=exposures)
    if found.figures["mse"].high < 0.0:
        say(
            "the pictures differ by less than their noise: it is not independent, or the error layers are of other "
            "pictures; the figures without noise mean nothing"
        )
    return found


def _lines(told: dict[str, Any]) -> Iterator[str]:
    free = told.get("noise_free", {})
    for name, value in told.items():
        if name == "hdr_exposures":
            yield f"{name:<13} {value['start']:.3g} to {value['stop']:.3g} EV, {value['steps']} of them"
        elif isinstance(value, float) and name != "exposure":
            yield f"{name:<13} {value:<12.6g}{_interval(free.get(name))}".rstrip()


def _interval(free: dict[str, float] | None) -> str:
    if free is None:
        return ""
    if free["value"] < 0.0 <= free["high"]:
        return f" without noise {free['value']:.4g} ({free['low']:.4g} to {free['high']:.4g}), no more than noise"
    if free["low"] != free["low"]:
        return f" without noise {free['value']:.4g} (how far that is off cannot be told)"
    return f" without noise {free['value']:.4g} ({free['low']:.4g} to {free['high']:.4g})"
