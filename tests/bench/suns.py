"""Methods of shading an asset under suns, compared with the path tracer.

    python -m tests.bench.suns REFERENCES SCENE.toml MODEL.pt ASSET.h5 [--lights behind front ...] [--spp 512]

The reference of each light is a path-traced picture of the scene, 96x96, read from `REFERENCES/scene.light.exr` or
rendered if missing; the sum of `sky` and of a sun of 1e5 over 0.53 degrees is `sky+sun`. Figures are over the object,
at an exposure that maps the 95th percentile of the reference to white: FLIP, MSE, relative MSE, and the share of
clamped light. Methods: `plain` (all light in spherical harmonics), `lobes` (harmonics and the asset's lobes), `clamp`
(sun and sky each clamped at 0), `window` (the sun's coefficients damped until they are nowhere negative), `window all`
(the same for all light), `vertex window` (the same for each vertex's transport), `entropy` (maximum-entropy
reconstruction), and `network`, evaluated in the sun's direction at the vertices, whose error no method can remove.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import prt_bake as prt
from formats.asset import Asset
from formats.image import read_layers
from prt_bake.comparison.metrics import compare
from prt_bake.geometry import camera
from prt_bake.lights.deringing import windowed
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, read_lighting
from prt_bake.lights.sun_detection import split_lighting
from prt_bake.lobes.interpolation import lobes_at
from prt_bake.lobes.light import lobe_radiance
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import fibonacci
from prt_bake.shading import vertices
from prt_bake.shading.asset_light import light_for
from prt_bake.shading.maximum_entropy import fit_maximum_entropy
from prt_bake.shading.sun_shading import interpolated_coefficients
from prt_bake.shipped.demonstration import SHIPPED

Array = NDArray[np.float64]

SIZE = 96
SUNS = {"behind": "-0.2,0.35,1", "front": "0.5,0.8,-1", "side": "1,0.3,0.1", "zenith": "0,1,0"}
SKY = str(SHIPPED / "sky.hdr")
IRRADIANCE = 1e5 * np.pi * np.radians(0.265) ** 2
SAMPLES = 3


def parts(light: str) -> list[tuple[str, str, float]]:
    """References that sum to a light: name, argument of `--light`, factor."""
    if light.startswith("sky+"):
        return [("sky", SKY, 1.0), *((name, source, IRRADIANCE) for name, source, _ in parts(light[4:]))]
    if light in SUNS:
        return [(light, f"sun:{SUNS[light]}:1,1,1:0.53", 1.0)]
    return [("sky", SKY, 1.0)] if light == "sky" else [(Path(light).stem.split("_")[0], light, 1.0)]


def lighting_of(light: str) -> Lighting:
    """The lighting of all parts of a light."""
    lights = [source.replace(":1,1,1:", f":{factor},{factor},{factor}:") for _, source, factor in parts(light)]
    return read_lighting(lights)


def reference(folder: Path, scene_path: Path, light: str, spp: int) -> tuple[Array, Array]:
    """The path-traced picture [H,W,3] and the object's coverage [H,W]."""
    picture = np.zeros((SIZE, SIZE, 3))
    scene = prt.load_scene(scene_path)
    view = camera.fit(scene.mesh, SIZE, SIZE, view="three-quarter-back")
    for name, source, factor in parts(light):
        path = folder / f"{scene_path.stem}.{name}.exr"
        if not path.exists():
            traced = prt.render_scene(scene, read_lighting([source]), view, spp, shown="scattered", background=False)
            prt.write_image(path, traced.image, layers={"coverage": traced.coverage})
        layers = read_layers(path)
        coverage = layers.layers["coverage"].reshape(SIZE, SIZE)
        picture += factor * layers.image
    return picture, coverage


class Viewed:
    """An asset from a fixed eye: the vertices that contribute to each sample, and their coefficients."""

    def __init__(self, asset: Asset) -> None:
        self.asset, self.view = asset, camera.fit(asset.mesh, SIZE, SIZE, view="three-quarter-back")
        steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        rays = camera.directions(self.view, slice(0, SIZE), offsets).reshape(-1, 3)
        hits = camera.Visibility(asset.mesh).first_hits(self.view.eye, rays)
        hit = np.flatnonzero(hits.faces >= 0)
        self._pixels = hit // SAMPLES**2
        corners, barycentric = asset.mesh.faces[hits.faces[hit]], hits.barycentric[hit]
        self._weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
        self.vertices, index = np.unique(corners, return_inverse=True)
        self._corners = index.reshape(-1, 3)
        at = sphere.bin_coordinates(
            vertices.eye_in_frames(asset, self.view.eye, self.vertices), asset.rings, asset.sectors
        )
        self.coefficients = interpolated_coefficients(asset, self.vertices, at)
        towards = self.view.eye - asset.mesh.positions[self.vertices]
        self.outgoing = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        normals, tangents = asset.mesh.normals[self.vertices], np.asarray(asset.tangents, np.float64)[self.vertices]
        self.local = sphere.to_local(self.outgoing, normals, tangents)

    def picture(self, radiance: Array) -> Array:
        """The picture [H,W,3] of radiance [n,3] at the visible vertices."""
        samples = np.einsum("sk,skc->sc", self._weights, radiance[self._corners])
        return (
            np.stack([np.bincount(self._pixels, channel, SIZE * SIZE) for channel in samples.T], axis=1).reshape(
                SIZE, SIZE, 3
            )
            / SAMPLES**2
        )


def radiance_by_method(viewed: Viewed, network: prt.NeuralBSSRDF, lighting: Lighting) -> dict[str, Array]:
    """Radiance [n,3] at the vertices by method, before the final clamp."""
    split, degree, a = split_lighting(lighting), viewed.asset.degree, viewed.coefficients

    def shade(harmonics: Array) -> Array:
        return np.asarray(np.einsum("nkc,kc->nc", np.broadcast_to(a, (*a.shape[:2], 3)), harmonics))

    harmonics = project_lighting(lighting, degree)
    sky = project_lighting(Lighting(split.skies, ()), degree) if split.skies else np.zeros_like(harmonics)
    suns = [project_lighting(Lighting((), (sun,)), degree) for sun in split.suns]
    begun = time.perf_counter()
    prepared = light_for(viewed.asset, lighting)
    print(f"    prepared in {1e3 * (time.perf_counter() - begun):.0f} ms")
    radiance = {"plain": shade(harmonics), "window all": shade(windowed(harmonics))}
    if prepared.lobes is not None and viewed.asset.lobes is not None:
        lobes = lobes_at(viewed.asset.lobes, viewed.vertices, viewed.local)
        radiance["lobes"] = radiance["plain"] + lobe_radiance(prepared.lobes, *lobes)
    if suns:
        radiance["clamp"] = np.maximum(shade(sky), 0.0) + sum(np.maximum(shade(sun), 0.0) for sun in suns)
        radiance["window"] = shade(sky + sum(windowed(sun) for sun in suns))
        damped = vertex_windowed(a)
        radiance["vertex window"] = shade(sky) + sum(np.einsum("nkc,kc->nc", damped, sun) for sun in suns)
        directions = np.array([sun.direction for sun in split.suns])
        irradiance = np.array([sun.irradiance for sun in split.suns])
        begun = time.perf_counter()
        radiance["entropy"] = shade(sky) + np.einsum(
            "ncd,dc->nc", fit_maximum_entropy(a).evaluate(directions), irradiance
        )
        print(f"    entropy: {1e3 * (time.perf_counter() - begun):.0f} ms for {len(a)} vertices")
        exact = network.evaluate(directions, viewed.asset.mesh.positions[viewed.vertices], viewed.outgoing)
        radiance["network"] = shade(sky) + np.einsum("ndc,dc->nc", exact.astype(np.float64), irradiance)
    return radiance


def vertex_windowed(a: Array) -> Array:
    """Coefficients [n,K,C], each function damped until it is nowhere negative on a lattice."""
    l = np.sqrt(np.arange(a.shape[1])).astype(int)
    harmonics = sh.evaluate(fibonacci(400), sh.degree_of(a.shape[1]))

    def spread_by(t: Array) -> Array:
        return np.asarray(a * np.exp(-t[:, None] * (l * (l + 1))[:, None]))

    def positive(t: Array) -> NDArray[np.bool_]:
        return np.asarray((np.einsum("dk,nkc->ndc", harmonics, spread_by(t)) >= 0.0).all(axis=1))

    low, high = np.zeros((len(a), a.shape[2])), np.full((len(a), a.shape[2]), 4.0)
    fine = positive(low)
    for _ in range(20):
        middle = 0.5 * (low + high)
        there = positive(middle)
        low, high = np.where(there, low, middle), np.where(there, middle, high)
    return spread_by(np.where(fine, 0.0, high))


def main() -> None:
    """Print a table for each light."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("references", type=Path)
    parser.add_argument("scene", type=Path, nargs="?", default=SHIPPED / "spot.toml")
    parser.add_argument("model", type=Path, nargs="?", default=SHIPPED / "spot.pt")
    parser.add_argument("asset", type=Path, nargs="?", default="spot.h5")
    parser.add_argument("--lights", nargs="+", default=["behind", "front", "side", "sky+behind", "sky+side"])
    parser.add_argument("--spp", type=int, default=512)
    args = parser.parse_args()
    network = prt.load_model(args.model)
    viewed = Viewed(prt.read_asset(args.asset))
    network = network.on(viewed.asset.mesh)
    for light in args.lights:
        truth, coverage = reference(args.references, args.scene, light, args.spp)
        mask = coverage > 0.5
        truth = truth * mask[..., None]
        exposure = -np.log2(np.quantile(truth[mask].max(axis=1), 0.95))
        print(f"{args.scene.stem}, {light}")
        for name, radiance in radiance_by_method(viewed, network, lighting_of(light)).items():
            kept = np.maximum(radiance, 0.0)
            error = compare(viewed.picture(kept) * mask[..., None], truth, mask, exposure)
            clamped = (kept - radiance).sum() / kept.sum()
            print(
                f"    {name:14} FLIP {error.flip:.4f}  MSE {error.mse:.5f}  relative MSE {error.relative_mse:.4f}"
                f"  clamped {clamped:.2%}"
            )


if __name__ == "__main__":
    main()
