"""What light does to a NeRFactor: how far its 16 × 32 pixels move a picture, and what a known light teaches.

First table: pictures of a model under each light and under its coarse version; relative RMSE on the object's pixels,
the noise of both pictures subtracted. Second table: the albedo that shows each single query exactly under one known
light, the best that pictures under that light can teach, and its error in a_lm under all light.
"""

import argparse

import numpy as np

import prt_bake as prt
from prt_bake.baselines import coarse_light
from prt_bake.baselines.lit_surface import LitSurface, Normals
from prt_bake.lights.harmonics import project_lighting
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.samples.queries import QuerySource

_DEGREE = 10


def main() -> None:
    parser = argparse.ArgumentParser(prog="nerfactor_light.py", description=__doc__)
    parser.add_argument("scene", help="scene.toml of the model")
    parser.add_argument("--model", help="model of the first table, which is left out without it")
    parser.add_argument("--light", action="append", default=[], help="as in `prtbake shade`; each is a row")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--queries", type=int, default=400)
    parser.add_argument("--paths", type=int, default=2048)
    options = parser.parse_args()
    scene = prt.load_scene(options.scene)
    lights = {light: prt.read_lighting(light, scene.up) for light in options.light}
    if options.model:
        pictures(scene, prt.load_model(options.model), lights, options.size, options.spp)
    known_light(scene, lights, options.queries, options.paths)


def pictures(scene, model, lights, size, spp) -> None:
    """Print how far pictures under the coarse light are from those under the sky."""
    print("light | coarse light: relative RMSE | noise of the pictures")
    camera = prt.fit_camera(scene.mesh, size, size, up=scene.up)
    for name, light in lights.items():
        rendered = [
            prt.render_network(model, scene.mesh, shown, camera, spp, seed, background=False)
            for seed, shown in enumerate((light, coarse_light(light, scene.up, enlarged=16)))
        ]
        on = rendered[0].coverage > 0.999
        fine, coarse = (picture.image[on].astype(np.float64) for picture in rendered)
        noise = sum((picture.standard_error[on].astype(np.float64) ** 2).sum() for picture in rendered)
        power = (fine**2).sum()
        moved = max(0.0, ((fine - coarse) ** 2).sum() - noise)
        print(f"{name} | {np.sqrt(moved / power):.1%} | {np.sqrt(noise / power):.1%}", flush=True)


def known_light(scene, lights, queries, paths) -> None:
    """Print the errors of a_lm of albedos that are exact under a sky; harmonics up to degree 10 stand for it."""
    drawn = QuerySource(prepare(scene), 1, 7).draw(0, queries)
    kind: Normals = "vertex" if scene.normals == "vertex" else "face"
    lit = LitSurface(scene.mesh, kind)
    points = lit.points(drawn.positions, drawn.outgoing)
    lattice = fibonacci(2048)
    basis = 4.0 * np.pi / len(lattice) * sh.evaluate(lattice, _DEGREE)
    white = np.concatenate(
        [lit.lambert(points.select([row]), lattice[None])[0][None] @ basis for row in range(queries)]
    )
    halves = [
        estimate_coefficients(scene, drawn.positions, drawn.outgoing, _DEGREE, paths, seed).mean for seed in (0, 1)
    ]
    low = [half[:, :9] for half in halves]

    def error(albedo) -> str:
        predicted = albedo[:, None] * white[:, :9, None]
        return f"{np.sqrt(((predicted - low[0]) * (predicted - low[1])).sum() / (low[0] * low[1]).sum()):.0%}"

    print("light | exact albedo | limited to 0.03–0.8 | one albedo, least squares of radiance | pixels above 0.8")
    mean = 0.5 * (halves[0] + halves[1])
    for name, light in lights.items():
        harmonics = project_lighting(light, _DEGREE)
        radiance, irradiance = np.einsum("nkc,kc->nc", mean, harmonics), white @ harmonics
        seen = irradiance > 1e-6 * irradiance.max()
        exact = np.divide(radiance, irradiance, out=np.zeros_like(radiance), where=seen)
        one = np.broadcast_to((radiance * irradiance).sum(axis=0) / (irradiance**2).sum(axis=0), exact.shape)
        errors = error(exact), error(np.clip(exact, 0.03, 0.8)), error(one)
        print(f"{name} | {' | '.join(errors)} | {np.mean(exact > 0.8):.0%}", flush=True)


if __name__ == "__main__":
    main()
