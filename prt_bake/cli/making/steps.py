"""The steps of `prtbake make`, and how they share its time.

Training takes 60 % of the time, the bake what is left until 85 %, pictures and compression the rest.
"""

import math
import os
import shlex
import shutil
import time
from itertools import takewhile
from pathlib import Path
from typing import Any

import typer

from formats.errors import PrtbakeError
from formats.journal import journal_folder
from prt_bake.cli.making.record import ASSET, COMPACT, MODEL, PICTURE, TURNTABLE, Record, model_files
from prt_bake.cli.shared import signals
from prt_bake.cli.shared.next_step import without_next
from prt_bake.cli.shared.progress import in_words, reporting, say
from prt_bake.network.file_names import state_path

TRAINING, REST = 0.6, 0.15
"""Shares of the time for the training, and for all that follows the bake."""
_LEAST_SHARE, _LEAST_SECONDS = 0.1, 30.0
"""Time that the bake has at least, however long the training took: its first pass must end, or nothing is written."""
_OVERRUN = 0.05
"""Share of the time by which the last steps may exceed it."""
_BAKE_ERROR, _COMPRESSION_ERROR = 0.02, 0.005
_COARSE = ("--rings", "4", "--sectors", "8", "--samples", "18", "--lobes", "0")
"""A bake that takes seconds, for slow machines whose time is over before an adaptive bake has its first pass."""
_PICTURE_SIDE, _TURNTABLE_SIDE = 512, 384
_FRAMES = (8, 36)
_FRAMES_A_SECOND = 12


class _OutOfTimeError(Exception):
    """Raised by a progress callback to end a step that is not worth more time."""


class Steps:
    """Runs the steps that a folder does not have yet."""

    def __init__(self, context: typer.Context, record: Record, scene: Path, mesh: Path, lights: list[str]) -> None:
        """`record.settings` has the time in minutes. Later runs have what finished steps left, or a part."""
        self._root = context.find_root().command
        self._record, self._scene, self._mesh, self._lights = record, scene, mesh, lights
        self._total = 60.0 * float(record.settings["minutes"])
        self._deadline = 0.0

    def run(self) -> None:
        """Run all steps, each of which is recorded in the folder; after one that is not finished, all later ones."""
        steps = {
            "train": self._train,
            "bake": self._bake,
            "picture": self._picture,
            "turntable": self._turntable,
            "compress": self._compress,
        }
        finished = list(takewhile(lambda step: step is not None, map(self._record.finished, steps)))
        self._record.steps = [step for step in finished if step is not None]
        self._deadline = time.monotonic() + max(REST * self._total, self._total - self._record.seconds)
        for step in self._record.steps:
            say(f"{step.name}: done already, in {in_words(step.seconds)}")
        for name in list(steps)[len(finished) :]:
            try:
                steps[name]()
            except (PrtbakeError, KeyboardInterrupt, typer.Exit):
                say(f"{name} was not finished; the same `prtbake make` continues there")
                raise

    def _train(self) -> None:
        model = self._file(MODEL)
        arguments = ["train", str(self._scene), "-o", model, "--minutes", _minutes(TRAINING * self._total)]
        resume = ["--resume"] if state_path(model).is_file() else []
        self._run("train", arguments, model_files(), resume)

    def _bake(self) -> None:
        asset = self._file(ASSET)
        resume = journal_folder(asset).is_dir() and "bake" in self._record.planned
        if not resume:  # a bake with another time cannot be resumed
            left = self._left() - REST * self._total
            self._record.planned["bake"] = _minutes(max(left, _LEAST_SHARE * self._total, _LEAST_SECONDS))
            self._record.write()
        arguments = ["bake", self._file(MODEL), str(self._mesh), "-o", asset, "--workers", str(os.cpu_count() or 1)]
        planned = self._record.planned["bake"]
        within = ["--error", f"{_BAKE_ERROR:g}", "--minutes", planned]
        latest = time.monotonic() + 60.0 * float(planned)
        try:
            self._run("bake", [*arguments, *within], [ASSET], ["--resume"] if resume else [])
        except PrtbakeError:
            if time.monotonic() < latest or _is_complete(Path(asset)):
                raise
            say(f"bake: not all vertices were ready after {planned} minutes; a coarse bake follows, of fewer views")
            self._run("bake", [*arguments, *_COARSE], [ASSET])

    def _picture(self) -> None:
        self._run("picture", self._shade(PICTURE, _PICTURE_SIDE), [PICTURE])

    def _turntable(self) -> None:
        seconds = _frame_seconds(Path(self._file(ASSET)), self._lights)
        frames = math.floor(min(_FRAMES[1], 0.5 * self._left() / max(seconds, 1e-3)))
        arguments = [
            *self._shade(TURNTABLE, _TURNTABLE_SIDE),
            "--turntable",
            "eye",
            "--frames",
            str(max(frames, _FRAMES[0])),
        ]
        arguments += ["--seconds", f"{max(frames, _FRAMES[0]) / _FRAMES_A_SECOND:.3g}"]
        if _FRAMES[0] * seconds > self._left() + _OVERRUN * self._total:
            self._skip("turntable", arguments)
        else:
            self._run("turntable", arguments, [TURNTABLE])

    def _compress(self) -> None:
        """Compress the asset; ended when the time is over, since every command reads the asset as it is."""
        from prt_bake.baking.compress import compress_file

        asset, compact = self._file(ASSET), self._file(COMPACT)
        arguments = ["compress", asset, "-o", compact, "--error", f"{_COMPRESSION_ERROR:g}"]
        latest = self._deadline + _OVERRUN * self._total
        self._announce("compress", arguments)
        began = time.monotonic()
        try:
            with reporting("compress") as show:

                def show_until_the_end(share: float | None, text: str, left: float | None = None) -> None:
                    show(share, text, left)
                    if time.monotonic() > latest:
                        raise _OutOfTimeError

                compress_file(Path(asset), Path(compact), _COMPRESSION_ERROR, show_until_the_end, _text(arguments))
        except _OutOfTimeError:
            self._skip("compress", arguments)
            return
        self._record.add("compress", _text(arguments), time.monotonic() - began, [COMPACT])

    def _shade(self, name: str, side: int) -> list[str]:
        lights = [word for light in self._lights for word in ("--light", light)]
        return ["shade", self._file(ASSET), *lights, "--reflection", "--size", f"{side}x{side}", "-o", self._file(name)]

    def _run(self, name: str, arguments: list[str], files: list[str], resume: list[str] | None = None) -> None:
        """Run a command and record it; files that an earlier try left are replaced, unless it is resumed."""
        self._announce(name, [*arguments, *(resume or [])])
        if not resume:
            for path in map(self._record.folder.joinpath, files):
                path.unlink(missing_ok=True)
                shutil.rmtree(journal_folder(path), ignore_errors=True)
        began = time.monotonic()
        words = [*arguments, *(resume or [])]
        with without_next():
            # Without the standalone mode a command returns its exit code, such as 130 after Ctrl-C.
            code = self._root.main(args=words, prog_name="prtbake", obj=_text(words), standalone_mode=False)
        if code or (code := signals.exit_code(0)):  # a command that was stopped may end as if it were finished
            raise typer.Exit(code)
        self._record.add(name, _text(arguments), time.monotonic() - began, files)

    def _announce(self, name: str, arguments: list[str]) -> None:
        say(f"{name}, {in_words(max(0.0, self._left()))} left of {in_words(self._total)}: {_text(arguments)}")

    def _skip(self, name: str, arguments: list[str]) -> None:
        say(f"{name}: left out, since the time is over; to do it by hand: {_text(arguments)}")
        self._record.add(name, _text(arguments), 0.0, [], "left out, since the time was over")

    def _file(self, name: str) -> str:
        return str(self._record.folder / name)

    def _left(self) -> float:
        return self._deadline - time.monotonic()


def _frame_seconds(asset: Path, lights: list[str]) -> float:
    """Return the time of one frame of the turntable, measured after a small one that loads what it needs."""
    from formats.asset import read_asset
    from prt_bake.geometry import camera
    from prt_bake.lights.lighting import read_lighting
    from prt_bake.shading.picture import render_picture

    baked = read_asset(asset)
    lighting = read_lighting(lights, baked.up, mesh=baked.mesh)
    for side in (8, _TURNTABLE_SIDE):
        began = time.monotonic()
        render_picture(baked, lighting, camera.fit(baked.mesh, side, side, up=baked.up), reflection=True)
    return time.monotonic() - began


def _is_complete(asset: Path) -> bool:
    from formats.asset import read_asset

    return asset.is_file() and bool(read_asset(asset).complete)


def _minutes(seconds: float) -> str:
    return f"{max(seconds, 0.1) / 60.0:.3g}"


def _text(arguments: list[str]) -> str:
    return shlex.join(["prtbake", *arguments])


def figures(folder: Path) -> dict[str, Any]:
    """Return the errors and the counts of the folder's asset."""
    from formats.asset import read_asset

    asset = read_asset(folder / ASSET)
    return {
        "error of the coefficients": str(asset.error),
        "errors": asset.error.as_json(),
        "vertices": len(asset.mesh.positions),
        "view bins": asset.rings * asset.sectors,
        "degree": asset.degree,
    }
