"""Commands that are killed, stopped by Ctrl-C, or find the disk full, at random moments.

    python -m tests.bench.accidents [--kills 100] [--stops 160] [--disks 50] [--only train bake …] [--seed 0]

An older output is in place. After an accident the output is the older one, or a file that its reader accepts whole;
Ctrl-C and full disks end with one sentence. Then the command is repeated, with --resume if it can be, and must give the
bits of an undisturbed run. The table counts what went otherwise, and lists the files left beside the output. Processes
are forked before any kernel has run, so that a run takes no time to start.
"""

import argparse
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from formats.asset import read_asset
from formats.image import read_layers, write_image
from formats.mesh import write_mesh
from formats.samples import read_samples
from prt_bake.cli.__main__ import run as prtbake
from prt_bake.cli.main import INTERRUPTED
from prt_bake.network.bssrdf import load_model
from tests.shapes import ball

_SCENE = """[object]
mesh = "ball.ply"
unit = "cm"
[interface]
eta = 1.3
roughness = 0.3
[medium]
sigma_t = 4.0
albedo = 0.9
"""
Bits = dict[str, bytes]


def _model(path: Path) -> Bits:
    return {name: tensor.numpy().tobytes() for name, tensor in load_model(path).state_dict().items()}


def _datasets(path: Path) -> Bits:
    found = {}

    def keep(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("provenance"):
            found[name] = np.asarray(item[()]).tobytes()

    with h5py.File(path) as file:
        file.visititems(keep)
    return found


def _asset(path: Path) -> Bits:
    with read_asset(path) as asset:
        complete = asset.complete
    return _datasets(path) if complete else {}


def _samples(path: Path) -> Bits:
    read_samples(path)
    return _datasets(path)


def _picture(path: Path) -> Bits:
    read = read_layers(path)
    if read.attributes.get("prtbake.complete") == "no":
        return {}
    return {name: np.ascontiguousarray(layer).tobytes() for name, layer in read.layers.items()}


@dataclass(frozen=True)
class Command:
    """A command line without its output, the name of the output, how it is read, and whether there is --resume.

    `beside` is what the command leaves beside its output.
    """

    line: str
    output: str
    read: Callable[[Path], Bits]
    resumes: bool = False
    beside: str = ""


COMMANDS = {
    "train": Command(
        "train ball.toml --steps 10 --synchronous --no-report --no-importance --force",
        "m.pt",
        _model,
        True,
        "m.train.pt",
    ),
    "sample": Command("sample ball.toml --count 3000 --force", "s.h5", _samples),
    "bake": Command("bake model.pt ball.ply --samples 512 --rings 4 --sectors 16 --force", "b.h5", _asset, True),
    "lobes": Command("lobes model.pt asset.h5 --force", "l.h5", _asset),
    "compress": Command("compress asset.h5 --error 0.01 --force", "c.h5", _asset),
    "render": Command("render ball.toml ball.ply --light sky.exr --size 48x48 --spp 64", "r.exr", _picture, True),
    "shade": Command("shade asset.h5 --light sky.exr --size 256x256", "p.exr", _picture),
}


class Folder:
    """A folder with inputs and, for each command, an older output and the bits of a new one."""

    def __init__(self, place: Path) -> None:
        self.place = place
        write_mesh(ball(2), place / "ball.ply")
        (place / "ball.toml").write_text(_SCENE)
        write_image(place / "sky.exr", np.random.default_rng(0).exponential(size=(16, 32, 3)))
        self.run("train ball.toml --steps 20 --no-report --no-importance -o model.pt")
        self.run("bake model.pt ball.ply --samples 64 --rings 4 --sectors 16 -o asset.h5")
        self.inputs = {path.name for path in place.iterdir()} | {"printed.txt"}
        self.older = b"an older output"

    def run(self, line: str, accident: Callable[[int], None] = lambda _: None, limit: int = 0) -> int:
        """Run a command in a forked process; returns its exit code, or minus the signal that ended it."""
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until the child is no longer the bench
        if child := os.fork():
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            accident(child)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.chdir(self.place)
        printed = os.open("printed.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until prtbake takes over
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        sys.argv = ["prtbake", *line.split()]
        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        code: object = 1
        try:
            prtbake()
        except SystemExit as end:
            code = end.code
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(int(str(code)))

    def clear(self) -> list[str]:
        """Remove everything but the inputs; returns the names."""
        left = sorted(path.name for path in self.place.iterdir() if path.name not in self.inputs)
        for name in left:
            path = self.place / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return left

    def sentence(self) -> str:
        """What is wrong with the output on the terminal: its last line must be a sentence of prtbake."""
        lines = (self.place / "printed.txt").read_text(errors="replace").strip().splitlines()
        if any("Traceback" in line for line in lines):
            places = [line.strip() for line in lines if line.startswith("  File")]
            return f"traceback: {lines[-1][:100]} in {places[-1:]}"
        return "" if lines and lines[-1].startswith("prtbake: ") else f"no sentence: {lines[-1:]}"


class Bench:
    """Accidents of one command, counted."""

    def __init__(self, folder: Folder, command: Command, draw: random.Random) -> None:
        self.folder, self.command, self.draw = folder, command, draw
        self.line = f"{command.line} -o {command.output}"
        self.output = folder.place / command.output
        folder.run(self.line)
        began = time.perf_counter()
        if code := folder.run(self.line):
            raise SystemExit(f"{self.line}: ended with {code}: {folder.sentence()}")
        self.seconds = time.perf_counter() - began
        self.bits = command.read(self.output)
        self.size = self.output.stat().st_size
        folder.clear()

    def series(self, name: str, count: int) -> None:
        """Cause accidents of one kind, and print their row."""
        faults, left, moments, early = Counter[str](), Counter[str](), 0, 0
        for number in range(count):
            if number % 2:
                self.output.write_bytes(self.folder.older)
            found, struck = self._accident(name)
            moments += struck
            early += self.output.exists() and self.output.read_bytes() != self.folder.older
            for fault in found:
                faults[fault] += 1
            left.update(set(self._again(faults)))
        beside = ", ".join(f"{file} {times}" for file, times in left.items()) or "nothing"
        print(f"{self.command.line.split()[0]:10}{name:11}{count:6}{moments:8}{early:6}{faults.total():8}  {beside}")
        for fault, times in faults.items():
            print(f"    {times} times: {fault}")

    def _accident(self, name: str) -> tuple[list[str], bool]:
        """Cause an accident: returns its faults, and whether it struck a running command."""
        moment, limit = self.draw.uniform(0.0, 1.05) * self.seconds, 0
        number = {"killed": signal.SIGKILL, "Ctrl-C": signal.SIGINT}.get(name, 0)
        if name == "disk full":
            limit = self.draw.randint(1, self.size)

        def strike(child: int) -> None:
            time.sleep(moment)
            os.kill(child, number)

        code = self.folder.run(self.line, strike if not limit else lambda _: None, limit)
        faults = []
        if code not in (0, 1, INTERRUPTED, -number):
            faults.append(f"exit code {code}")
        if code in (1, INTERRUPTED) and (fault := self.folder.sentence()):
            faults.append(fault)
        if self.output.exists() and self.output.read_bytes() != self.folder.older:
            try:
                self.command.read(self.output)
            except Exception as fault:  # whatever a reader raises, the output is broken
                faults.append(f"a broken output: {fault!r:.100}")
        elif code == 0:
            faults.append("exit code 0 without an output")
        return faults, code != 0

    def _again(self, faults: Counter[str]) -> list[str]:
        """Finish the command; returns the names of the files that the accident left."""
        there = sorted(path.name for path in self.folder.place.iterdir() if path.name not in self.folder.inputs)
        left = [name for name in there if name != self.command.output]
        resume = " --resume" if self.command.resumes and any(not name.endswith(".part") for name in left) else ""
        code = self.folder.run(self.line + resume)
        if code:
            lines = (self.folder.place / "printed.txt").read_text(errors="replace").strip().splitlines()
            faults[f"the repeated command{resume} ends with {code}: {lines[-1:]}"] += 1
        elif self.command.read(self.output) != self.bits:
            faults[f"the repeated command{resume} gives other bits"] += 1
        # `.part` is what a killed process was writing.
        kept = (self.command.output, self.command.beside)
        remains = [name for name in self.folder.clear() if name not in kept and not name.endswith(".part")]
        if remains and not code:
            faults[f"left after the repeated command: {remains}"] += 1
        return [".part" if name.endswith(".part") else name for name in left]


def main() -> None:
    """Print a row for each command and kind of accident."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="of each command")
    parser.add_argument("--stops", type=int, default=160, help="Ctrl-C, of each command")
    parser.add_argument("--disks", type=int, default=50, help="full disks, of each command")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(f"{'command':10}{'accident':11}{'times':>6}{'struck':>8}{'new':>6}{'faults':>8}  left beside the output")
    with tempfile.TemporaryDirectory() as place:
        folder = Folder(Path(place))
        for name in args.only:
            bench = Bench(folder, COMMANDS[name], random.Random(f"{name} {args.seed}"))
            for accident, count in (("killed", args.kills), ("Ctrl-C", args.stops), ("disk full", args.disks)):
                bench.series(accident, count)


if __name__ == "__main__":
    main()
