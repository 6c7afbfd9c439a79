"""Makes the gallery of the documentation: each scene path traced and from a baked asset, with errors and costs.

    python docs/make_gallery.py [--quick] [--work bench/gallery] [--out docs]

Reads `docs/gallery/gallery.toml`. Writes `gallery.md`, and into `gallery/` a strip of four pictures for each scene,
`figures.json`, and in `live/` a small asset of each for the page in the browser. Large assets and path-traced pictures
stay in the folder of `--work`: a second run repeats only what is missing or has other inputs. `--quick` makes one
scene, tiny and coarse.
"""

import argparse
import os
import shutil
import textwrap
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import prt_bake as prt
from formats.atomic import sha256
from formats.json_report import write_report
from prt_bake.baking.compress import compress_file
from prt_bake.cli.shared.progress import say
from prt_bake.comparison.noise import PixelErrors
from prt_bake.comparison.noise_free import compare_without_noise
from prt_bake.geometry.camera import View
from prt_bake.paper.artefacts import Artefacts, Facts
from prt_bake.shading.tone_map import agx

ROOT = Path(__file__).resolve().parents[1]
GAP = 6
"""Pixels between two pictures of a strip."""


def timed(build: Callable[[Path], object]) -> Callable[[Path], Facts]:
    """`build`, with the processor time of all threads and the size of the file as facts."""

    def measured(path: Path) -> Facts:
        start = time.process_time()
        build(path)
        return {"processor": time.process_time() - start, "MB": path.stat().st_size / 1e6}

    return measured


class Subject:
    """A scene of the gallery: its model, asset and pictures, made when they are asked for."""

    def __init__(self, entry: dict[str, Any], files: Artefacts, quality: dict[str, Any]) -> None:
        self.entry, self.files, self.quality, self.name = entry, files, quality, entry["name"]
        self.scene = prt.load_scene(ROOT / entry["scene"])
        self.view: View = "three-quarter-back" if entry.get("back") else "three-quarter"
        size = {"width": quality["pixels"], "height": quality["pixels"]}
        self.camera = prt.fit_camera(self.scene.mesh, view=self.view, up=self.scene.up, **size)

    def model(self) -> Path:
        """The model's file; trained unless the entry names one."""
        if "model" in self.entry:
            return ROOT / str(self.entry["model"])
        inputs = {"scene": self.scene.content_hash, "minutes": self.quality["training"]}
        build = timed(lambda path: prt.train(self.scene, minutes=self.quality["training"], output=path))
        return self.files.make(f"{self.name}.pt", inputs, build).path

    def asset(self) -> tuple[prt.Asset, Facts]:
        """The asset, and the facts of its bake."""
        model, options = self.model(), self.quality["bake"] | self.entry.get("bake", {})
        times = self.entry.get("subdivide", 0)

        def bake(path: Path) -> None:
            mesh = self.scene.mesh
            for _ in range(times):
                mesh = prt.Mesh.from_trimesh(mesh.to_trimesh().subdivide())
            workers = os.cpu_count() or 1
            prt.bake(prt.load_model(model), mesh, out=path, workers=workers, resume=True, **options)

        inputs = {"model": sha256(model), "bake": options} | ({"subdivided": times} if times else {})
        made = self.files.make(f"{self.name}.h5", inputs, timed(bake))
        return prt.read_asset(made.path), made.facts

    def write_live(self, error: float, path: Path) -> None:
        """Write the asset of the live page: compact, and without lobes, which that page does not show."""
        large = self.files.folder / f"{self.name}.h5"

        def compress(compact: Path) -> None:
            compress_file(large, compact, error, lobes=False)

        inputs = {"asset": sha256(large), "error": error}
        shutil.copy(self.files.make(f"{self.name}.live.h5", inputs, timed(compress)).path, path)

    def traced(self, name: str, lights: list[str], light: prt.Lighting) -> tuple[Any, Facts]:
        """The path-traced picture with its layers, and the facts of its rendering. Unscattered light is left out."""

        def render(path: Path) -> None:
            ends = {"spp": None, "minutes": self.quality["minutes"], "error": self.quality["noise"]}
            done = prt.render_scene(self.scene, light, self.camera, shown="scattered", **ends)
            prt.write_image(path, done.image, layers={"error": done.standard_error, "coverage": done.coverage})

        inputs = {"scene": self.scene.content_hash, "light": lights[1:], "sky": sha256(Path(lights[0]))}
        inputs |= {"view": self.view} | {each: self.quality[each] for each in ("pixels", "minutes", "noise")}
        made = self.files.make(f"{self.name}.{name.replace(' ', '_')}.exr", inputs, timed(render))
        return prt.read_layers(made.path), made.facts

    def compare(self, lights: dict[str, list[str]], strip: Path) -> dict[str, Any]:
        """Write the strip of all pictures, and return the figures."""
        asset, bake = self.asset()
        figures, pictures = [], []
        for name, (sky, *suns) in lights.items():
            arguments = [str(ROOT / sky), *suns]
            light = prt.read_lighting(arguments, self.scene.up, 180.0 if self.entry.get("back") else 0.0)
            layers, facts = self.traced(name, arguments, light)
            truth = layers.image.astype(np.float64)
            sigma = layers.layers["error"].reshape(truth.shape).astype(np.float64)
            inside = layers.layers["coverage"].reshape(truth.shape[:2]) >= 1.0
            prt.render_picture(asset, light, self.camera, samples=1)  # compiles or loads the kernels
            start = time.process_time()
            shaded = prt.render_picture(asset, light, self.camera)
            seconds = time.process_time() - start
            exposure = float(-np.log2(np.quantile(truth[inside].max(axis=1), 0.95)))
            errors = PixelErrors(np.zeros_like(truth), sigma, np.zeros_like(truth))
            free = compare_without_noise(shaded.image, truth, errors, inside, exposure).figures
            noise = float(np.sqrt((sigma[inside] ** 2).sum() / (truth[inside] ** 2).sum()))
            row: dict[str, Any] = {"light": name, "stated": shaded.errors and shaded.errors.as_json(), "noise": noise}
            row |= {each: free[each].as_json() for each in ("relative_rmse", "flip")}
            figures.append(row | {"tracing": facts["processor"], "shading": seconds})
            pictures += [prt.srgb(agx(image, exposure)) for image in (layers.image, shaded.image)]
        apart = np.full((self.quality["pixels"], GAP, 3), 255, np.uint8)
        joined = np.concatenate([part for picture in pictures for part in (apart, picture)][1:], axis=1)
        Image.fromarray(joined).save(strip, quality=90, method=6)
        return {**self.entry, "vertices": len(asset.mesh.positions), "baked": bake, "pictures": figures}


def section(figures: dict[str, Any]) -> str:
    """The part of the page on one scene."""
    size = f"{figures['vertices']:,} vertices; asset of {figures['baked']['MB']:.0f} MB"
    lines = [
        f"## {figures['title']}\n",
        textwrap.fill(f"{figures['text']} Scene `{figures['scene']}`, {size}.", 120) + "\n",
        f"![{figures['title']}: path traced and baked, in two lights](gallery/{figures['name']}.webp)\n",
        "| light | error stated | error measured | FLIP | path tracing | shading |\n|---|---|---|---|---|---|",
    ]
    for each in figures["pictures"]:
        total = each["stated"] and each["stated"]["total"]
        least = "" if total is None or each["stated"]["complete"] else "at least "
        stated = "unknown" if total is None else f"{least}{total:.1%}"
        rmse, flip = ([each[name][part] for part in ("value", "low", "high")] for name in ("relative_rmse", "flip"))
        lines.append(
            f"| {each['light']} | {stated} | {rmse[0]:.1%} ({rmse[1]:.1%} to {rmse[2]:.1%}) "
            f"| {flip[0]:.3f} ({flip[1]:.3f} to {flip[2]:.3f}) "
            f"| {each['tracing']:.0f} s, noise {each['noise']:.0%} | {each['shading']:.1f} s |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Make the gallery."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--work", type=Path, default=ROOT / "bench" / "gallery")
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    args = parser.parse_args()
    settings = tomllib.loads((ROOT / "docs" / "gallery" / "gallery.toml").read_text(encoding="utf-8"))
    files, quality = Artefacts(args.work, say), settings["quick" if args.quick else "quality"]
    folder, made = args.out / "gallery", []
    (folder / "live").mkdir(parents=True, exist_ok=True)
    for entry in settings["scene"][1:2] if args.quick else settings["scene"]:
        strip = folder / f"{entry['name']}.webp"
        subject = Subject(entry, files, quality)
        made.append(subject.compare(settings["lights"], strip))
        if error := entry.get("live", settings["live"]["error"]):
            subject.write_live(error, folder / "live" / f"{entry['name']}.h5")
        write_report({"scenes": made}, folder / "figures.json")
        say(f"{strip}: written")
    head = (ROOT / "docs" / "gallery" / "head.txt").read_text(encoding="utf-8")
    (args.out / "gallery.md").write_text("\n".join([head, *map(section, made)]), encoding="utf-8")


if __name__ == "__main__":
    main()
