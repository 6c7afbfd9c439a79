"""`prtbake compare`: measures the difference between an image and a reference."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from formats.extras import require
from prt_bake.cli.shared.bounds import Bounds, FailAbove, FailBelow
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.options import AsJson, optional_output
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say
from prt_bake.cli.shared.test_sets import TOO_SMALL, score_folders

if TYPE_CHECKING:
    from formats.image.exr import Layers
    from prt_bake.comparison.noise import PixelErrors
    from prt_bake.comparison.noise_free import NoiseFree

_MAPS = (".png", ".exr")
_UNKNOWN = {
    "ssim": TOO_SMALL,
    "ssim_quarter": "unknown: it needs pictures of at least 44x44 pixels, and blocks of 4x4 mostly within the mask",
    "relative_rmse": "unknown: the reference is black",
}
"""Why a figure is NaN."""


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
    reference: Annotated[
        Path,
        typer.Argument(
            metavar="REFERENCE",
            help="Reference image of the same size. Or two folders: predicted pictures, and a test set of `prtbake "
            "sample --olat`.",
        ),
    ],
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="M",
            help="Image that is white, or opaque if it has an alpha channel, at the pixels to compare.",
            show_default=False,
        ),
    ] = None,
    exposure: Annotated[
        float | None,
        typer.Option(
            min=-64,
            max=64,
            metavar="EV",
            help="Compare at 2^EV times the radiance; by default 0, and for folders chosen from the references.",
            show_default=False,
        ),
    ] = None,
    hdr_exposures: Annotated[
        Any,
        typer.Option(
            parser=_read_range,
            metavar="START,STOP",
            help="Exposure range of HDR-FLIP in stops, on top of --exposure; by default computed from the reference.",
            show_default=False,
        ),
    ] = None,
    keep_noise: Annotated[
        bool, typer.Option("--keep-noise", help="Do not estimate the figures without noise.")
    ] = False,
    picture: Annotated[
        Path | None,
        optional_output(
            "--picture --sheet",
            "P.png",
            "Also write a sheet: image, reference, signed difference, FLIP and HDR-FLIP, with scales and figures.",
            ".png",
        ),
    ] = None,
    difference_map: Annotated[
        Path | None,
        optional_output("--difference-map", "D.png", "Also write image − reference (.exr: values).", *_MAPS),
    ] = None,
    flip_map: Annotated[
        Path | None, optional_output("--flip-map", "F.png", "Also write the FLIP map (.exr: values).", *_MAPS)
    ] = None,
    hdr_flip_map: Annotated[
        Path | None,
        optional_output("--hdr-flip-map", "F.png", "Also write the HDR-FLIP map (.exr: values).", *_MAPS),
    ] = None,
    fail_above: FailAbove = None,
    fail_below: FailBelow = None,
    as_json: AsJson = False,
) -> None:
    """Compare an image with a reference.

    Prints MSE, relative MSE and RMSE, SSIM (full and quarter size), FLIP and HDR-FLIP. If the images have an error
    layer, as .exr files of `prtbake render` and `prtbake shade` do, the figures are also estimated without that noise,
    each with a 95 % confidence interval. Warns if only one of two images by `prtbake render` holds unscattered or
    reflected light. Ignores pixels that are transparent in both images. Of two folders, prints the means over pictures.
    """
    if image.is_dir() or reference.is_dir():
        only_pictures = {"--mask": mask, "--hdr-exposures": hdr_exposures, "--picture": picture}
        only_pictures |= {"--difference-map": difference_map, "--flip-map": flip_map, "--hdr-flip-map": hdr_flip_map}
        only_pictures |= {"--fail-above": fail_above, "--fail-below": fail_below}
        for option, value in only_pictures.items():
            if value:
                raise typer.BadParameter(f"{option} is for two images; leave it out to compare folders")
        return score_folders(image, reference, exposure, keep_noise, as_json)
    stops = exposure or 0.0
    outputs = {"--picture": picture, "--difference-map": difference_map}
    outputs |= {"--flip-map": flip_map, "--hdr-flip-map": hdr_flip_map}
    check_outputs(outputs, {"IMAGE": image, "REFERENCE": reference, "--mask": mask})
    refuse_other_kinds({"IMAGE": (image, ("sky",)), "REFERENCE": (reference, ("sky",)), "--mask": (mask, ("sky",))})
    plotted = ("matplotlib",) if any(outputs.values()) else ()
    require("compare", "skimage", "flip_evaluator", *plotted)
    from formats.image import read_layers
    from formats.json_report import as_text
    from prt_bake.comparison import sheet
    from prt_bake.comparison.alpha import premultiplied
    from prt_bake.comparison.metrics import checked
    from prt_bake.comparison.metrics import compare as measure

    bounds = Bounds.of(fail_above or [], fail_below or [])
    layers, reference_layers = (premultiplied(path, read_layers(path)) for path in (image, reference))
    pixels, target = layers.image, reference_layers.image
    selected = None if mask is None else _read_mask(mask)
    _refuse_other_sizes(image, pixels, (reference, target), *([] if selected is None else [(mask, selected)]))
    for remark in _remarks(image, reference, layers, reference_layers):
        say(remark)
    if selected is None:
        selected = _mask_by_alpha(image, reference, layers, reference_layers)
    names = (str(image), str(reference), str(mask))
    hdr = True if hdr_exposures is None else hdr_exposures
    comparison = measure(pixels, target, selected, stops, hdr=hdr, names=names)
    errors = None if keep_noise else _errors(image, reference, layers, reference_layers)
    noise_free = None
    if errors is not None:
        noise_free = _without_noise(pixels, target, errors, selected, stops, comparison.hdr_exposures)
    exposed, exposed_target, compared = checked(pixels, target, selected, stops)
    if picture is not None:
        intervals = None if noise_free is None else noise_free.figures
        undimmed = None if selected is None else compared
        titles = (image.name, reference.name)
        sheet.write_sheet(picture, pixels, target, comparison, titles, stops, undimmed, intervals)
    if difference_map is not None:
        sheet.write_difference_map(difference_map, exposed - exposed_target)
    for path, values in ((flip_map, comparison.flip_map), (hdr_flip_map, comparison.hdr_flip_map)):
        if path is not None and values is not None:
            sheet.write_flip_map(path, values)
    figures = {**comparison.as_json(), "pixels": int(compared.sum()), "exposure": stops}
    if noise_free is not None:
        figures["noise_free"] = noise_free.as_json()
    if as_json:
        print(as_text(figures))
    else:
        for line in _lines(figures):
            print(line)
    bounds.refuse_broken(image, figures)


def _refuse_other_sizes(image: Path, pixels: Any, *others: Any) -> None:
    from formats.errors import QueryError

    h, w = pixels.shape[:2]
    for path, other in others:
        if other.shape[:2] != (h, w):
            height, width = other.shape[:2]
            raise QueryError(
                f"{image}: is {w}x{h}, but {path} is {width}x{height}; images are compared pixel by pixel, so bring "
                "both to one size"
            )


def _read_mask(path: Path) -> Any:
    """Return the image's alpha as the mask, or its stored values if it has no alpha."""
    from formats.image import read_alpha, read_data

    alpha = read_alpha(path)
    if alpha is None or (alpha >= 1.0).all():
        return read_data(path)
    say(f"{path}: the alpha channel is used as the mask")
    return alpha


def _mask_by_alpha(image: Path, reference: Path, layers: "Layers", reference_layers: "Layers") -> Any:
    """Return the pixels that are visible in either image, if some are transparent in both; else None."""
    from prt_bake.comparison.alpha import alpha_of, covered_in_either

    seen = covered_in_either(layers, reference_layers)
    if seen is not None:
        say(f"{(~seen).sum()} of {seen.size} pixels are transparent in both images and are ignored")
        return seen
    for path, read in ((image, layers), (reference, reference_layers)):
        if alpha_of(read) is not None:
            say(
                f"{path}: the alpha channel is ignored: transparent pixels are compared as black; --mask {path} "
                "compares the opaque pixels alone"
            )
    return None


def _remarks(image: Path, reference: Path, layers: "Layers", reference_layers: "Layers") -> Iterator[str]:
    contents = [str(read.attributes.get("prtbake.shows", "")) for read in (layers, reference_layers)]
    yield from _unshared_light(image, reference, *contents)
    for path, pixels in ((image, layers.image), (reference, reference_layers.image)):
        negative = int((pixels < 0.0).any(axis=2).sum())
        if negative:
            yield f"{path}: {negative} of {pixels[..., 0].size} pixels hold negative radiance, shown as black"


def _unshared_light(image: Path, reference: Path, shows: str, reference_shows: str) -> Iterator[str]:
    """Yield a remark per kind of light that only one of two images holds, by their attribute `prtbake.shows`."""
    if not (shows and reference_shows):
        return
    for light, option in (
        ("unscattered light", "--no-unscattered"),
        ("light reflected at the surface", "--no-reflection"),
    ):
        holds = [light in text and f"{light} left out" not in text for text in (shows, reference_shows)]
        if holds[0] != holds[1]:
            holding, lacking = (image, reference) if holds[0] else (reference, image)
            yield f"{holding} holds {light}, {lacking} does not: the figures include it ({option} excludes it)"


def _errors(image: Path, reference: Path, layers: "Layers", reference_layers: "Layers") -> "PixelErrors | None":
    """Return the images' standard errors; None, after a message, if they cannot be used."""
    import numpy as np

    from prt_bake.comparison.noise import errors_of, same_random_numbers, unusable_reason

    reasons = [unusable_reason(path, read) for path, read in ((image, layers), (reference, reference_layers))]
    for reason in filter(None, reasons):
        say(reason)
    errors = None if any(reasons) else errors_of(layers, reference_layers)
    if errors is None:
        return None
    if np.array_equal(layers.image, reference_layers.image):
        say(f"{image} and {reference} are the same picture: there is no noise to remove")
        return None
    if same_random_numbers(layers, reference_layers):
        say(
            f"{image} and {reference} were rendered with the same random numbers; their noise is correlated and cannot "
            "be removed; render one of them with another --seed"
        )
        return None
    if errors.shared.any():
        say(
            "the error of a bake is correlated between neighbouring pixels: it is removed from squared differences "
            "only, which widens their intervals; FLIP and SSIM still include it"
        )
    return errors


def _without_noise(
    pixels: Any, target: Any, errors: "PixelErrors", mask: Any, exposure: float, exposures: Any
) -> "NoiseFree":
    from prt_bake.comparison.noise_free import compare_without_noise

    noise_free = compare_without_noise(pixels, target, errors, mask, exposure, hdr=exposures)
    if noise_free.figures["mse"].high < 0.0:
        say(
            "the images differ by less than their noise: the noise is not independent, or the error layers belong to "
            "other images; ignore the figures without noise"
        )
    return noise_free


def _lines(figures: dict[str, Any]) -> Iterator[str]:
    noise_free = figures.get("noise_free", {})
    for name, value in figures.items():
        if name == "hdr_exposures":
            yield f"{name:<13} {value['start']:.3g} to {value['stop']:.3g} EV, {value['steps']} exposures"
        elif name in _UNKNOWN and math.isnan(value):
            yield f"{name:<13} {_UNKNOWN[name]}"
        elif isinstance(value, float) and name != "exposure":
            yield f"{name:<13} {value:<12.6g}{_interval(noise_free.get(name))}".rstrip()


def _interval(estimate: dict[str, float] | None) -> str:
    if estimate is None:
        return ""
    value, low, high = estimate["value"], estimate["low"], estimate["high"]
    if math.isnan(low):
        return f" without noise {value:.4g} (interval unknown)"
    noise_alone = ", no more than noise" if value < 0.0 <= high else ""
    return f" without noise {value:.4g} ({low:.4g} to {high:.4g}){noise_alone}"
