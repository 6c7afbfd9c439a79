"""The steps of `prtbake make`, and how they share its time.

Training takes 55 % of the time, the bake what is left until 90 %, pictures and compression the rest. Time that
interrupted runs lost is taken from all of them.
"""

import contextlib
import io
import json
import math
import os
import shlex
import shutil
import time
from pathlib import Path
from typing import Any

import typer

from formats.errors import PrtbakeError
from formats.journal import journal_folder
from prt_bake.cli.making.record import ASSET, COMPACT, MODEL, PICTURE, TURNTABLE, Record, model_files
from prt_bake.cli.shared import signals
from prt_bake.cli.shared.next_step import command, without_next
from prt_bake.cli.shared.progress import in_words, reporting, say
from prt_bake.network.file_names import report_paths, state_path

TRAINING, REST = 0.55, 0.1
"""Shares of the time for the training, and for all that follows the bake."""
_LEAST_SHARE, _LEAST_SECONDS = 0.1, 30.0
"""Time that the bake has at least, however long the training took: its first pass must end, or nothing is written."""
_LEAST_USABLE = 0.5
"""Share of the time by which steps are planned, however much of it interrupted runs lost."""
_OVERRUN = 0.05
"""Share of the time by which the last steps may exceed it."""
_BAKE_ERROR, COMPRESSION_ERROR = 0.02, 0.005
_START_SECONDS = 10.0
"""What a bake takes until its first vertex, generously."""
_MOST = 0.5
"""Share of the vertices from which a bake that is late goes on: their rest takes less time than a coarse bake."""
_COARSE = ("--rings", "4", "--sectors", "8", "--samples", "18", "--lobes", "0")
"""A bake that takes seconds, for slow machines whose time is over before an adaptive bake has its first pass."""
_PICTURE_SIDE, _TURNTABLE_SIDE, _TURNTABLE_SAMPLES = 512, 256, 2
_FRAMES, _TURN_SECONDS = (12, 72), 3.0
"""Least and most frames of a turn: 4 and 24 a second."""


class _OutOfTimeError(Exception):
    """Raised by a progress callback to end a step that is not worth more time."""


class Steps:
    """Runs the steps that a folder does not have yet."""

    def __init__(
        self,
        context: typer.Context,
        record: Record,
        scene: Path,
        mesh: Path,
        lights: list[str],
        start: Path | None = None,
    ) -> None:
        """`record` has the settings, the time, and what earlier runs spent of it; `start` is an earlier model."""
        self._start = [] if start is None else ["--from", str(start)]
        self._root, self._typed = context.find_root().command, shlex.split(context.obj)
        self._record, self._scene, self._mesh, self._lights = record, scene, mesh, lights
        self._total = 60.0 * record.minutes
        self._began, self._before = time.monotonic(), record.spent
        self._deadline = self._began + max(REST * self._total, self._total - self._before)

    def run(self) -> None:
        """Run all steps that are not finished, each of which is recorded in the folder."""
        steps = {
            "train": self._train,
            "bake": self._bake,
            "picture": self._picture,
            "turntable": self._turntable,
            "compress": self._compress,
        }
        names = self._unfinished(list(steps))
        self._record.steps = [step for step in self._record.steps if step.name not in names]
        for step in self._record.steps:
            say(f"{step.name}: done already, in {in_words(step.seconds)}")
        for name in names:
            try:
                steps[name]()
            except (PrtbakeError, KeyboardInterrupt, typer.Exit):
                again = command(*(word for word in self._typed if word != "--force"))
                say(f"{name} was not finished; finished steps are kept, and this continues with {name}: {again}")
                if stopped := signals.exit_code(0):  # the step's message names its --resume, which `make` lacks
                    raise typer.Exit(stopped) from None
                raise
            finally:
                self._record.spent = self._before + time.monotonic() - self._began
                self._record.write()

    def _unfinished(self, names: list[str]) -> list[str]:
        """Return the steps to do: everything depends on the model and the asset, and nothing on the pictures."""
        unfinished = [name for name in names if self._record.finished(name) is None]
        first = names.index(unfinished[0]) if unfinished else len(names)
        return names[first:] if first < names.index("picture") else unfinished

    def _train(self) -> None:
        model = self._file(MODEL)
        lost = self._record.spent - self._record.kept
        usable = max(self._total - lost, _LEAST_USABLE * self._total)
        arguments = ["train", str(self._scene), "-o", model, "--minutes", _minutes(TRAINING * usable), *self._start]
        for path in report_paths(model):  # of a shorter training
            path.unlink(missing_ok=True)
        self._run("train", arguments, model_files(), state_path(Path(model)))
        shutil.rmtree(journal_folder(self._file(ASSET)), ignore_errors=True)  # of a bake of an earlier model
        say(f"{model}: {_quality(model)}")

    def _bake(self) -> None:
        asset = self._file(ASSET)
        seconds = max(self._left() - REST * self._total, _LEAST_SHARE * self._total, _LEAST_SECONDS)
        arguments = ["bake", self._file(MODEL), str(self._mesh), "-o", asset, "--workers", str(os.cpu_count() or 1)]
        ready, after = self._bake_for(seconds, arguments), f"were ready after {_minutes(seconds)} minutes"
        if _MOST <= ready < 1.0:
            say(f"bake: {ready:.0%} of the vertices {after}; the others follow")
            ready = self._bake_for(2.0 * seconds * (1.0 / ready - 1.0) + _START_SECONDS, arguments)
        if ready < 1.0:
            say(f"bake: not all vertices {after}; a coarse bake follows, of fewer views")
            self._run("bake", [*arguments, *_COARSE], [ASSET])

    def _bake_for(self, seconds: float, arguments: list[str]) -> float:
        """Bake, or continue the bake, for a time. Returns the share of the vertices that are ready then."""
        asset, latest = Path(self._file(ASSET)), time.monotonic() + seconds
        within = ["--error", f"{_BAKE_ERROR:g}", "--minutes", _minutes(seconds)]
        try:
            self._run("bake", [*arguments, *within], [ASSET], journal_folder(asset))
        except PrtbakeError:
            stopped = signals.exit_code(0) != 0
            if stopped or time.monotonic() < latest or (ready := _share_ready(asset)) == 1.0:
                raise
            return ready
        return 1.0

    def _picture(self) -> None:
        self._run("picture", self._shade(PICTURE, _PICTURE_SIDE), [PICTURE])

    def _turntable(self) -> None:
        seconds = _frame_seconds(Path(self._file(ASSET)), self._lights)
        least, most = _FRAMES
        frames = max(least, math.floor(min(most, 0.5 * self._left() / max(seconds, 1e-3))))
        arguments = [*self._shade(TURNTABLE, _TURNTABLE_SIDE), "--samples", str(_TURNTABLE_SAMPLES)]
        arguments += ["--turntable", "eye", "--frames", str(frames), "--seconds", f"{_TURN_SECONDS:g}"]
        if least * seconds > self._left() + _OVERRUN * self._total:
            self._skip("turntable", arguments)
        else:
            self._run("turntable", arguments, [TURNTABLE])

    def _compress(self) -> None:
        """Compress the asset; ended when the time is over, since every command reads the asset as it is."""
        from prt_bake.baking.compress import compress_file

        asset, compact = self._file(ASSET), self._file(COMPACT)
        arguments = ["compress", asset, "-o", compact, "--error", f"{COMPRESSION_ERROR:g}"]
        latest = self._deadline + _OVERRUN * self._total
        self._announce("compress", arguments)
        began = time.monotonic()
        try:
            with reporting("compress") as show:

                def show_until_the_end(share: float | None, text: str, left: float | None = None) -> None:
                    show(share, text, left)
                    if time.monotonic() > latest:
                        raise _OutOfTimeError

                compress_file(Path(asset), Path(compact), COMPRESSION_ERROR, show_until_the_end, _text(arguments))
        except _OutOfTimeError:
            self._skip("compress", arguments)
            return
        self._record.add("compress", _text(arguments), time.monotonic() - began, [COMPACT])

    def _shade(self, name: str, side: int) -> list[str]:
        lights = [word for light in self._lights for word in ("--light", light)]
        options = self._record.pictures["options"]
        size = ["--size", f"{side}x{side}"]
        return ["shade", self._file(ASSET), *lights, "--reflection", *options, *size, "-o", self._file(name)]

    def _run(self, name: str, arguments: list[str], files: list[str], state: Path | None = None) -> None:
        """Run a command and record it; files that an earlier try left are replaced, unless `state` exists.

        state: of an interrupted run of the command, which --resume continues.
        """
        resume = ["--resume"] if state is not None and state.exists() else []
        self._announce(name, [*arguments, *resume])
        before = self._record.unfinished.pop(name, 0.0)
        if not resume:
            before = 0.0
            for path in map(self._record.folder.joinpath, files):
                path.unlink(missing_ok=True)
                shutil.rmtree(journal_folder(path), ignore_errors=True)
        began = time.monotonic()
        words = [*arguments, *resume]
        shown = portable(_text(words))
        try:
            # The page has what these commands print, in other words. Without the standalone mode a command returns its
            # exit code, such as 130 after Ctrl-C.
            with without_next(), contextlib.redirect_stdout(io.StringIO()):
                code = self._root.main(args=words, prog_name="prtbake", obj=shown, standalone_mode=False)
            if code or (code := signals.exit_code(0)):  # a command that was stopped may end as if it were finished
                raise typer.Exit(code)
        except (PrtbakeError, KeyboardInterrupt, typer.Exit):
            if state is not None and state.exists():
                self._record.unfinished[name] = before + time.monotonic() - began
            raise
        self._record.add(name, _text(arguments), before + time.monotonic() - began, files)

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
        view = camera.fit(baked.mesh, side, side, up=baked.up)
        render_picture(baked, lighting, view, reflection=True, samples=_TURNTABLE_SAMPLES)
    return time.monotonic() - began


def _quality(model: str) -> str:
    """The quality of a model in words: that of its report, if there is time for one, else of its training."""
    report, _page = report_paths(model)
    if report.is_file():
        return str(json.loads(report.read_text(encoding="utf-8"))["summary"][0])
    from prt_bake.cli.shared.after_training import quality_of
    from prt_bake.network.bssrdf import load_model

    return quality_of(load_model(model))


def _share_ready(path: Path) -> float:
    """The share of the vertices that an asset has; 0 if there is none."""
    from formats.asset import read_asset

    if not path.is_file():
        return 0.0
    asset = read_asset(path)
    return 1.0 if asset.complete else min(float(asset.valid.mean()), 0.999)


def _minutes(seconds: float) -> str:
    return f"{max(seconds, 0.1) / 60.0:.3g}"


def portable(line: str) -> str:
    """The command with the file name alone of the shipped sky, whose path is that of one installation."""
    from prt_bake.shipped.examples import example

    sky = example("sky.hdr")
    return line.replace(str(sky), sky.name)


def _text(arguments: list[str]) -> str:
    return command("prtbake", *arguments)


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
        "lobes": asset.provenance["lobes"],
    }
