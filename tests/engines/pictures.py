"""Pictures that engines must reproduce: assets, views, lights, and `prtbake shade`'s pictures of them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import prt_bake as prt
from formats.asset import Asset
from prt_bake.lights.environment import rotation
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.picture import Picture
from tests.formats.mesh.gltf_files import GltfBuilder
from tests.shading.assets import asset_of

TURN = [0.1, 0.2, 0.3, 0.86**0.5]  # quaternion of a node, as in glTF
PIXELS = 128
RINGS, SECTORS = 8, 32
SUN = {"y": np.array([0.6, 0.5, 0.6245]), "z": np.array([0.6, -0.6245, 0.5])}  # in front, above
IRRADIANCE = [3.0, 2.7, 2.1]


@dataclass(frozen=True)
class Situation:
    """An asset under a light. turn: degrees of the object, sky_turn: of the sky, both about the up axis. mirrored: the
    object, y up, along z before it is turned.
    """

    asset: Asset
    light: str
    turn: float = 0.0
    sky_turn: float = 0.0
    mirrored: bool = False

    @property
    def camera(self) -> prt.Camera:
        return prt.fit_camera(self.asset.mesh, PIXELS, PIXELS, up=self.asset.up)

    def picture(self, sky: Path) -> Picture:
        """The picture by the product: object at rest, camera and light turned, and mirrored, backwards."""
        mirror = np.diag([1.0, 1.0, -1.0 if self.mirrored else 1.0])
        camera, back = self.camera, mirror @ rotation(-self.turn, self.asset.up)
        camera = replace(camera, eye=back @ camera.eye, target=back @ camera.target)
        words = f"sun:{','.join(map(str, mirror @ SUN[self.asset.up]))}:{','.join(map(str, IRRADIANCE))}"
        light = words if self.light == "sun" else str(sky)
        rotate = 0.0 if self.light == "file" else self.sky_turn - self.turn  # the file's light turns with the object
        lighting = prt.read_lighting(light, up=self.asset.up, rotate=-rotate if self.mirrored else rotate)
        if self.mirrored and self.light == "sky":
            lighting = replace(lighting, skies=[replace(one, image=one.image[:, ::-1]) for one in lighting.skies])
        picture = prt.render_picture(self.asset, lighting, camera, samples=4, suns="plain", background=False)
        if not self.mirrored:
            return picture
        return replace(picture, image=picture.image[:, ::-1], coverage=picture.coverage[:, ::-1])


def relative_rms(found: np.ndarray, picture: Picture) -> float:
    """Root mean square difference over that of the picture, on the pixels that the object covers."""
    covered = picture.coverage == 1
    return float(np.sqrt(np.square(found - picture.image)[covered].sum() / np.square(picture.image[covered]).sum()))


def soft_asset(up: str = "y", unit: str = "dm") -> Asset:
    """The shipped object with transport as in a turbid medium: diffuse, and forward; harmonics of degree 3 suffice."""
    mesh = prt.read_mesh(prt.example("spot.obj"))
    tangents = sphere.tangent_frame(mesh.normals)
    outgoing = sphere.to_world(sphere.view_bins(RINGS, SECTORS)[None], mesh.normals[:, None], tangents[:, None])
    at_normal, onwards = sh.evaluate(mesh.normals, 2)[:, None], sh.evaluate(-outgoing, 2)  # [V,1,9], [V,B,9]
    random = np.random.default_rng(0)
    varied = sh.evaluate(outgoing, 3) @ (0.03 * random.normal(size=(16, 9)))  # every harmonic of the view occurs
    towards = 1.0 + 0.4 * np.einsum("vi,vbi->vb", mesh.normals, outgoing)[..., None]
    band = np.repeat([1.0, 0.667, 0.25], [1, 3, 5])
    values = [
        c * (band * at_normal * towards + d * band * onwards + varied) for c, d in ((0.3, 0.2), (0.25, 0.3), (0.2, 0.5))
    ]
    return asset_of(mesh, np.stack(values, axis=-1).astype(np.float16), RINGS, SECTORS, 2, up=up, unit=unit)


def write_users_file(mesh: prt.Mesh, path: Path, scale: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
    """The object as a user may have it: two parts, split at every face, with texture coordinates, turned by a node, and
    scaled or mirrored along its axes.
    """
    file = GltfBuilder()
    *axis, w = TURN
    x = np.cross(np.eye(3), axis)  # x @ v is the product axis × v
    local_to_object = np.eye(3) + 2 * w * x + 2 * x @ x
    parts = []
    for faces in np.array_split(mesh.faces, 2):
        positions = mesh.positions[faces.ravel()] @ local_to_object / scale
        normals = mesh.normals[faces.ravel()] @ local_to_object * scale
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        part = file.solid(positions, np.arange(len(positions)), NORMAL=file.accessor(normals))
        file.json["accessors"][part["attributes"]["POSITION"]] |= bounds
        part["attributes"]["TEXCOORD_0"] = file.accessor(positions[:, :2])
        parts.append(part)
    file.node(mesh=file.mesh(*parts), rotation=TURN, scale=list(scale))
    file.write(path)
