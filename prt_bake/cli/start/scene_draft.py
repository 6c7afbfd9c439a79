"""The text of a new scene file, with comments on every number."""

import json
import os
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from formats.mesh import Mesh
from formats.scene.materials import Material, to_scene_units
from formats.scene.units import MILLIMETRES, NO_UNIT
from prt_bake.inspection.translucency import GUIDE, Translucency, channels, lengths, translucency

_BYTES_A_VERTEX = 40_000
"""Of a default bake: 1,024 view bins, nine RGB harmonics in float16, compressed as HDF5 does."""


@dataclass(frozen=True, eq=False)
class SceneDraft:
    """What a new scene file says.

    Attributes:
        path: the scene file.
        mesh_path, mesh: the object.
        material: its medium, index of refraction and roughness.
        unit_in_mm: millimetres per unit of the mesh.
        up: the axis that points up.
        normals: "vertex" or "face".
    """

    path: Path
    mesh_path: Path
    mesh: Mesh
    material: Material
    unit_in_mm: float
    up: Literal["y", "z"]
    normals: Literal["vertex", "face"]

    @property
    def light(self) -> Translucency:
        """How far light travels in the object; lengths are in millimetres."""
        longest, thin = (self.unit_in_mm * length for length in lengths(self.mesh))
        scattering, absorption = self.material.sigma_s_reduced, self.material.sigma_a
        return translucency(np.array(scattering), np.array(absorption), 0.0, longest, thin)

    def text(self) -> str:
        """Return the file's content."""
        parts = (self._object(), self._interface(), self._medium(), self._more_keys(), self._next_steps())
        return "\n\n".join("\n".join(part) for part in parts) + "\n"

    def _object(self) -> Iterator[str]:
        known = [name for name, length in MILLIMETRES.items() if length == self.unit_in_mm]
        yield f"# {_one_line(self.mesh_path.name)} in {self.material.name}"
        yield ""
        yield "[object]"
        yield f"mesh = {_quoted(_relative(self.mesh_path, self.path))}"
        yield f'up = "{self.up}"  # the axis that points up, "y" or "z"'
        if known:
            yield f'unit = "{known[0]}"  # of the numbers in the mesh: its longest side is {self.light.size:.4g} mm'
        else:
            yield f'unit = "{NO_UNIT}"'
            yield (
                f"unit_in_mm = {self.unit_in_mm:.7g}  # millimetres per unit of the mesh: its longest side is "
                f"{self.light.size:.4g} mm"
            )

    def _interface(self) -> Iterator[str]:
        smooth = "smooth" if self.normals == "vertex" else "flat faces; the mesh has hard edges"
        yield "[interface]"
        yield f"eta = {self.material.eta:g}  # index of refraction; 1 bends and reflects no light"
        yield f"roughness = {self.material.roughness:g}  # GGX alpha: 0 polished, 0.15 glossy, 0.3 satin, 0.6 matt"
        yield f'normals = "{self.normals}"  # {smooth}; "vertex" or "face"'
        yield "energy_compensation = false  # true: a rough surface loses no light by a second scattering at it"

    def _medium(self) -> Iterator[str]:
        pure = to_scene_units(self.material, 0.0, self.unit_in_mm)
        light = self.light
        yield "[medium]"
        yield f"material = {_quoted(self.material.name)}  # `prtbake materials` lists all"
        yield "density = 1.0  # of twice the density, light spreads half as far"
        yield f"# Source: {_one_line(self.material.source)}."
        yield "# Numbers of your own, red, green and blue, in place of material and density; these are the same:"
        yield f"# sigma_t = {_numbers(pure.sigma_t)}  # extinction per unit of the mesh"
        yield f"# albedo = {_numbers(pure.albedo)}  # share of it that is scattered, not absorbed"
        yield "# phase_g = 0.0  # mean cosine of a scattering: 0 to all sides, towards 1 forwards"
        yield "#"
        yield f"# Transport mean free path: {channels(light.transport)} mm. The longest side of the object,"
        yield f"# {light.size:.4g} mm, is {channels(light.size / light.transport)} of them."
        yield f"# {GUIDE[0].upper()}{GUIDE[1:]}."
        yield f"# Diffuse light that crosses its thin parts, {light.thin:.3g} mm: {light.percent_crossing}."

    def _more_keys(self) -> Iterator[str]:
        feature = 0.1 * self.light.size / self.unit_in_mm
        yield "# All other keys, to be used without the first #. Veins, or soft spots, of a second material:"
        yield "# [medium.mix]"
        yield '# material = "marble vein"  # and density; or sigma_t and albedo'
        yield '# pattern = "veins"  # thin sheets; "noise" is soft spots, "turbulence" billows with creases'
        yield f"# feature = {feature:.3g}  # size of the largest features, in units of the mesh"
        yield "# thresholds = [0.7, 0.95]  # none of it where the pattern, 0 to 1, is at the first, all at the second"
        yield "# octaves = 4  # number of sizes, each half of the one before"
        yield "# resolution = 64  # cells along the longest side"
        yield "# seed = 0"
        yield "#"
        yield "# Another closed mesh inside the object, with keys as above; tables can be repeated:"
        yield "# [[inside]]"
        yield '# name = "core"'
        yield '# mesh = "core.obj"'
        yield '# in = "object"  # the part that contains it'
        yield "# [inside.interface]"
        yield "# eta = 1.33"
        yield "# [inside.medium]"
        yield '# material = "wax"'
        yield '# An opaque body has instead of them: surface = "diffuse" and reflectance (number, RGB, file).'
        yield "#"
        yield "# roughness may be an image file; sigma_t and albedo may be .npy grids [Z,Y,X] or [Z,Y,X,3] in a box"
        yield "# with two corners: bounds = [[x, y, z], [x, y, z]]."

    def _next_steps(self) -> Iterator[str]:
        vertices, name = len(self.mesh.positions), self.path.stem
        model, asset, mesh = f"{name}.pt", f"{name}.h5", _relative(self.mesh_path, self.path)
        yield "# Next, in this folder; all steps at once, in 20 minutes:"
        yield f"#   {_command('make', self.path.name, '-o', name)}"
        yield "# or one by one:"
        yield f"#   {_command('train', self.path.name, '-o', model, '--minutes', '10')}"
        yield f"#   {_command('bake', model, mesh, '-o', asset)}"
        yield f"#     a few minutes; about {_BYTES_A_VERTEX * vertices / 1e6:,.0f} MB for {vertices:,} vertices"
        yield f"#   {_command('view', asset)}"


def _relative(file: Path, scene: Path) -> str:
    """Return the name of a file relative to the folder of the scene file, or the absolute one if that is shorter."""
    absolute = file.resolve()
    try:
        relative = Path(os.path.relpath(absolute, scene.resolve().parent))
    except ValueError:  # another drive
        return absolute.as_posix()
    return min(relative.as_posix(), absolute.as_posix(), key=len)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False, allow_nan=False).replace("\x7f", "\\u007f")


def _one_line(text: str) -> str:
    """Return text for a comment: TOML allows no control characters in it."""
    return "".join(letter if letter >= " " and letter != "\x7f" else " " for letter in text).strip()


def _command(*words: str) -> str:
    return _one_line(shlex.join(["prtbake", *words]))


def _numbers(values: object) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in np.asarray(values)) + "]"
