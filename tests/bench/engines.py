"""What engines and browsers make of an asset, compared with `prt.shade` and `prtbake shade --suns plain`.

    python -m tests.bench.engines spot.h5 [--pictures FOLDER]

The page of `prtbake export` in Chromium, Godot's web runtime, and Blender where `make test-blender` has installed it.
`make test-engines` installs the other programs. With --pictures it writes blender.webp and godot.webp.
"""

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

import prt_bake as prt
from formats.image import read_image
from tests import ROOT
from tests.engines import test_blender, test_godot
from tests.engines.conftest import node
from tests.engines.pages import BACKENDS, camera_of, drive, make_site
from tests.engines.pages import relative_rms as rms_of_vertices
from tests.engines.pictures import Situation, relative_rms
from tests.shading.assets import asset_of

SKY = Path(prt.example("sky.hdr"))
LIGHTS = (("file", 150.0, 0.0), ("sun", 150.0, 0.0), ("sky", 215.0, 75.0))
"""The light, the turn of the object and that of the sky, in degrees."""
EYES = ([-1.0, 2.0, 3.0], [3.0, 0.5, -1.0], [0.2, -2.0, -3.0])


def page(path: Path, asset: prt.Asset, folder: Path) -> None:
    """Print the time to open the page, and the errors of vertices and of a picture."""
    site, camera = make_site(folder / "site", [path], [SKY]), prt.fit_camera(asset.mesh, 120, 90)
    light = prt.project_environment(prt.read_environment(SKY), asset.degree, asset.up)
    words = light.ravel().tolist()
    steps = [
        ["ready"],
        ["state"],
        *(["radiance", eye, words] for eye in EYES),
        ["picture", camera_of(camera, 3), words],
    ]
    true = prt.render_picture(asset, prt.read_lighting(SKY), camera, suns="plain", background=False).image
    for name, backend in BACKENDS.items():
        _, state, *found, rows = drive(node, site, steps, **backend)
        worst = max(rms_of_vertices(one, prt.shade(asset, light, eye)) for one, eye in zip(found, EYES, strict=True))
        picture = np.reshape(rows, (90, 3, 120, 3, 4)).mean(axis=(1, 3))[..., :3]
        print(
            f"page, {name}: opened in {state['opened'] / 1e3:.1f} s, self-test {state['selftest']:.1e}, vertices "
            f"{worst:.3%}, picture {rms_of_vertices(picture, true):.2%}"
        )


def frames(folder: Path) -> None:
    """Print the time of JavaScript in a frame of 40,962 vertices, while the view and the light are dragged."""
    mesh = prt.Mesh.from_trimesh(trimesh.creation.icosphere(subdivisions=6))
    transport = np.full((len(mesh.positions), 8, 9, 3), 0.1, np.float16)
    prt.write_asset(asset_of(mesh, transport, 2, 4, 2), folder / "fine.h5")
    drag = ["drag", [250, 200], [350, 260]]
    steps = [["ready"], *[drag, ["rest"], [*drag, {"key": "Shift"}], ["rest"]] * 5, ["state"]]
    for name, backend in BACKENDS.items():
        *_, state = drive(node, make_site(folder / f"fine {name}", [folder / "fine.h5"], [SKY]), steps, **backend)
        times = state["frames"][1:]  # the first one compiles the shader
        print(f"page, {name}: a frame of {len(mesh.positions):,} vertices {np.median(times):.1f} ms of JavaScript")


def pictures(asset: prt.Asset, folder: Path) -> dict[str, list[np.ndarray]]:
    """Print the errors of pictures by Godot and Blender, and return the pictures of the float file by program."""
    prt.export_gltf(asset, folder / "float.glb")
    prt.export_gltf(asset, folder / "int8.glb", quantize="int8")
    situations = [Situation(asset, *each) for each in LIGHTS]
    true = [situation.picture(SKY) for situation in situations]
    forms = ("float", "int8")
    jobs = [test_godot.job_of(each, f"{form}.glb", SKY) for form in forms for each in situations]
    drawn = test_godot.run_godot(node, folder, [folder / f"{form}.glb" for form in forms], jobs)
    made = {f"Godot, {form}": drawn[3 * i : 3 * i + 3] for i, form in enumerate(forms)}
    python = ROOT / ".venv/blender/bin/python"
    for engine in ("CYCLES", "BLENDER_EEVEE_NEXT") if python.exists() else ():
        work = [
            test_blender.job_of(each, engine, folder / "float.glb", SKY, folder / f"{engine}{i}")
            for i, each in enumerate(situations)
        ]
        test_blender.rendered(python, work, folder)
        made[f"Blender, {engine}"] = [read_image(job["picture"])[..., :3] for job in work]
    for name, each in made.items():
        errors = [f"{light[0]} {relative_rms(one, p):.2%}" for light, one, p in zip(LIGHTS, each, true, strict=True)]
        print(f"{name}: {', '.join(errors)}")
    return made


def write_strip(path: Path, images: list[np.ndarray]) -> None:
    """Write pictures side by side, at one exposure, as bright as fits."""
    exposure = np.log2(0.7 / max(float(np.percentile(image, 99.5)) for image in images))
    strip = Image.fromarray(np.concatenate([prt.srgb(image, exposure=exposure) for image in images], axis=1))
    strip.save(path, quality=95)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--pictures", type=Path)
    args = parser.parse_args()
    os.environ.setdefault("CHROMIUM", "/usr/bin/chromium")
    asset = prt.read_asset(args.asset)
    with tempfile.TemporaryDirectory() as folder:
        page(args.asset, asset, Path(folder))
        frames(Path(folder))
        made = pictures(asset, Path(folder))
    for name, key in (("godot", "Godot, float"), ("blender", "Blender, CYCLES")):
        if args.pictures and key in made:
            write_strip(args.pictures / f"{name}.webp", made[key])


if __name__ == "__main__":
    main()
