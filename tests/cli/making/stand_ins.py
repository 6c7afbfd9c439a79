"""Commands in place of those that `prtbake make` runs: they only write their files and turn a clock."""

import json
import shutil
import signal
from pathlib import Path
from typing import Annotated

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.making.make import make
from prt_bake.cli.shared import signals
from prt_bake.cli.shared.next_step import command, say_next

SECONDS = {"train": 660.0, "bake": 200.0, "picture": 8.0, "turntable": 20.0}


class StandIns:
    """Commands that write their files, how long each takes, and one that fails after it has written half.

    `by_ctrl_c`: a signal stops it. `slow`: a bake takes all its time and has no asset then.
    """

    def __init__(self, asset):
        self.asset, self.seconds, self.now = asset, dict(SECONDS), 0.0
        self.calls, self.broken, self.slow, self.frame, self.part = [], "", False, 4.0, 1.0
        self.by_ctrl_c, self.start, self.shown_command = False, None, ""
        self.app = typer.Typer()
        for function in (make, self.train, self.bake, self.shade):
            self.app.command(function.__name__)(function)

    def run(self, *arguments, standalone=False):
        """Run `prtbake make` and return what it called; `standalone` ends with SystemExit, as the program does."""
        self.calls = []
        words = ["make", *map(str, arguments)]
        self.app(args=words, obj=command("prtbake", *words), standalone_mode=standalone)
        return self.calls

    def finish(self, name, output, *facts):
        self.calls.append((name, *facts))
        self.now += self.part * self.seconds[name]
        output.write_bytes(b"half")
        if name == self.broken:
            self.leave_half(output)
            raise PrtbakeError(f"{name}: stopped")
        if name == "bake":
            shutil.copy(self.asset, output)

    def leave_half(self, output):
        Path(f"{output}.journal").mkdir(exist_ok=True)
        if self.by_ctrl_c:
            signals.record(signal.SIGINT)

    def train(
        self,
        scene: Path,
        output: Annotated[Path, typer.Option("-o")],
        minutes: float = 0.0,
        resume: Annotated[bool, typer.Option("--resume")] = False,
        start: Annotated[Path | None, typer.Option("--from")] = None,
    ) -> None:
        self.start = start
        output.with_name("model.train.pt").write_bytes(b"state")
        self.finish("train", output, minutes, resume)
        output.with_name("model.report.html").write_text("report")
        say_next("prtbake", "bake", output)

    def bake(
        self,
        source: Path,
        mesh: Path,
        output: Annotated[Path, typer.Option("-o")],
        error: float = 0.0,
        minutes: float = 0.0,
        workers: int = 1,
        resume: Annotated[bool, typer.Option("--resume")] = False,
        rings: int = 16,
        sectors: int = 64,
        samples: int = 64,
        lobes: int = 4,
    ) -> None:
        assert source.is_file()
        assert mesh.is_file()
        if self.slow and minutes and not resume:
            self.calls.append(("bake", error, minutes, resume))
            self.now += 60.0 * minutes
            self.leave_half(output)
            raise PrtbakeError("nothing was written")
        assert resume or not Path(f"{output}.journal").exists()
        self.finish("bake", output, rings if self.slow else error, minutes, resume)

    def shade(
        self,
        context: typer.Context,
        asset: Path,
        light: Annotated[list[str], typer.Option("--light")],
        output: Annotated[Path, typer.Option("-o")],
        size: str = "",
        turntable: str = "",
        frames: int = 0,
        seconds: float = 0.0,
        reflection: Annotated[bool, typer.Option("--reflection")] = False,
        samples: int = 3,
        tone_map: str = "none",
        exposure: float = 0.0,
        view: str = "",
    ) -> None:
        assert reflection
        assert seconds == (3.0 if turntable else 0.0)
        shown, self.shown_command = (tone_map, exposure, view), context.obj
        self.finish("turntable" if turntable else "picture", output, frames, *map(str, light), *shown)


def summary():
    return json.loads(Path("out/summary.json").read_text())
