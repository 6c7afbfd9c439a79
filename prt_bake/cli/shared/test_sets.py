"""Test sets on the command line: `prtbake sample --olat` writes one, `prtbake compare` of folders scores pictures."""

from pathlib import Path
from typing import TYPE_CHECKING

from formats.errors import PrtbakeError, QueryError
from formats.extras import require
from prt_bake.cli.shared.next_step import say_next
from prt_bake.cli.shared.outputs import check_outputs, warn_of_small_disk
from prt_bake.cli.shared.progress import in_words, reporting, say, stopping

if TYPE_CHECKING:
    from prt_bake.olat.score import SetScore
    from prt_bake.olat.settings import OlatSettings

TOO_SMALL = "unknown: it needs pictures of at least 11x11 pixels"
"""In place of the SSIM of pictures that are smaller than its window."""


def write_olat(scene_path: Path, folder: Path, settings: "OlatSettings", skies: list[Path], dry_run: bool) -> None:
    """Print size and time of a test set, and write it unless `dry_run`."""
    from formats.scene import read_scene
    from prt_bake.olat.description import NAME
    from prt_bake.olat.render import OlatSet
    from prt_bake.shipped.examples import example
    from prt_bake.tracer.prepared import no_values_reason

    scene = read_scene(scene_path)
    if settings.light_diameter == 0.0 and (reason := no_values_reason(scene)):
        raise QueryError(
            f"{scene_path}: {reason}; paths cannot hit a light without size there; add --light-diameter 10 (degrees)"
        )
    olat = OlatSet(scene, folder, settings, skies or [example("sky.hdr")])
    if not dry_run:
        check_outputs({"--output": folder / NAME}, {"SCENE": scene_path, "--sky": skies}, folder)
    with reporting("sample", "pilot pictures") as show:
        cost = olat.predict()
    left = cost.pictures - cost.finished
    print(
        f"{folder}: {cost.pictures:,} pictures of {settings.width}x{settings.height}, about {_size(cost.bytes)}"
        + (f"; {cost.finished:,} are finished" if cost.finished else "")
        + (f"; about {in_words(cost.seconds)} for {'the others' if cost.finished else 'all'}" if left else "")
        + (f"; noise under one light about {cost.noise:.0%}" if cost.noise == cost.noise else ""),
        flush=True,
    )
    if dry_run:
        return
    warn_of_small_disk(folder, cost.bytes)
    with reporting("sample") as show, stopping() as stop:
        done = olat.write(stop, show)
    if done < cost.pictures:
        raise PrtbakeError(
            f"{folder}: stopped; {done:,} of {cost.pictures:,} pictures are finished, and the same command continues"
        )
    print(f"{folder}: {done:,} pictures; dataset.json says what they are")
    say_next("prtbake", "compare", "PREDICTED", folder)


def score_folders(predicted: Path, folder: Path, exposure: float | None, keep_noise: bool, as_json: bool) -> None:
    """Print the scores of a folder of predicted pictures against a test set."""
    for path, what in ((predicted, "predicted pictures"), (folder, "a test set")):
        if not path.is_dir():
            raise QueryError(f"{path}: expected a folder, of {what}, found none; folders are compared with folders")
    require("compare", "skimage", "flip_evaluator")
    from formats.json_report import as_text
    from prt_bake.olat.score import score

    with reporting("compare") as show:
        scores = score(predicted, folder, exposure=exposure, keep_noise=keep_noise, progress=show)
    if as_json:
        print(as_text({name: found.as_json() for name, found in scores.items()}))
        return
    for name, found in scores.items():
        print(f"{name}: {len(found.pictures)} pictures, exposure {found.exposure:+.2f} EV")
        for line in _lines(found):
            print(f"  {line}")
        if found.shares_noise():
            say(
                f"{name}: the predictions are nearer to the references than their noise, as copies are; the figures "
                "mean nothing"
            )
        if len(found.pictures) < 8 and not keep_noise:
            say(f"{name}: an interval needs 8 pictures or more")


def _lines(found: "SetScore") -> list[str]:
    report, lines = found.as_json(), []
    for metric in ("mse", "psnr", "ssim", "flip"):
        measured = report["measured"][metric]["value"]
        if measured != measured:  # SSIM alone can be unknown
            lines.append(f"{metric:<5} {TOO_SMALL}")
            continue
        line = f"{metric:<5} {measured:<10.4g}"
        free, noise = report["noise_free"][metric], report["of_noise"][metric]
        if free["value"] == free["value"]:
            line += f" without noise {free['value']:<10.4g}"
            line += f" ({free['low']:.4g} to {free['high']:.4g})" if free["low"] == free["low"] else ""
            line += f"  noise alone {noise:.4g}" if noise == noise else ""
        lines.append(line.rstrip())
    return lines


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
