"""What the plotter draws: the object, the sky behind it, and a reference picture.

They are PyVista actors with shaders of their own (`prt_bake.preview.shaders`), which encode linear radiance as sRGB and
reflect the sky; PyVista's colours have 8 bits. No light of the plotter reaches them.
"""

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from vtkmodules.vtkCommonDataModel import vtkDataObject
from vtkmodules.vtkCommonMath import vtkMatrix3x3
from vtkmodules.vtkRenderingCore import vtkPolyDataMapper

from formats.mesh import Mesh
from prt_bake.preview import shaders
from prt_bake.preview.mirrored import ALBEDOS, Interface, directional_albedo
from prt_bake.shading.tone_map import ToneMap


class Shaded(ABC):
    """A mesh drawn by our shader, with one picture as its texture.

    Attributes:
        actor: the PyVista actor.
    """

    def __init__(self, mesh: pv.PolyData) -> None:
        self.mesh = mesh
        self._mapper = vtkPolyDataMapper()  # unlike `pv.DataSetMapper`, it passes arrays to the vertex shader
        self._mapper.SetInputData(mesh)
        self._mapper.ScalarVisibilityOff()
        self.actor = pv.Actor(mapper=self._mapper)
        self._uniforms: Any = self.actor.GetShaderProperty().GetFragmentCustomUniforms()
        self._tone_map: ToneMap = "none"
        self.set_exposure(0.0)

    def set_exposure(self, exposure: float, tone_map: ToneMap = "none") -> None:
        """Set the exposure in EV and the tone map."""
        self._uniforms.SetUniformf("gain", 2.0**exposure)
        if tone_map != self._tone_map:
            self._tone_map = tone_map
            self._write_shader()

    def set_picture(self, picture: NDArray[np.float32]) -> None:
        """Set the texture to a linear picture [H,W,3], row 0 on top."""
        texture = pv.Texture(np.asarray(picture[::-1], np.float32))  # PyVista flips it back: row 0 is at v = 0
        texture.interpolate = True
        texture.repeat = True
        self.actor.texture = texture
        self._uniforms.SetUniformf("halfRow", 0.5 / len(picture))

    @abstractmethod
    def _write_shader(self) -> None:
        """Write the shaders again."""

    def _set_vector(self, name: str, vector: NDArray[np.float64]) -> None:
        self._uniforms.SetUniform3f(name, vector.tolist())

    def _set_sky_rotation(self, to_sky: NDArray[np.float64]) -> None:
        matrix = vtkMatrix3x3()
        matrix.DeepCopy(to_sky.T.ravel().tolist())  # GLSL matrices are column-major
        self._uniforms.SetUniformMatrix("toSky", matrix)

    def _extend_vertex_shader(self, declarations: str, code: str) -> None:
        for tag, text in (("//VTK::PositionVC::Dec", declarations), ("//VTK::PositionVC::Impl", code)):
            self.actor.add_shader_replacement("vertex", tag, f"{tag}\n{text}")

    def _replace_fragment_shader(self, declarations: str, code: str) -> None:
        # VTK declares the texture at this tag, so our declarations follow it. The code replaces all of VTK's colouring.
        tag = "//VTK::TCoord::Dec"
        self.actor.add_shader_replacement("fragment", tag, f"{tag}\n{declarations}")
        self.actor.add_shader_replacement("fragment", "//VTK::TCoord::Impl", code)


class _FullScreen(Shaded):
    """A picture that covers the window, behind everything else."""

    def __init__(self, declarations: str, code: str) -> None:
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
        mesh = pv.PolyData.from_regular_faces(corners, [[0, 1, 2], [0, 2, 3]])
        mesh.active_texture_coordinates = 0.5 + 0.5 * corners[:, :2]
        super().__init__(mesh)
        self.actor.use_bounds = False
        self._declarations, self._code = declarations, code
        self._write_shader()

    def _write_shader(self) -> None:
        self.actor.clear_shader_replacements()
        self.actor.add_shader_replacement("vertex", "//VTK::PositionVC::Impl", shaders.FULL_SCREEN)
        self._replace_fragment_shader(shaders.encode(self._tone_map) + self._declarations, self._code)


class Sky(_FullScreen):
    """The sky behind the object, at infinity."""

    def __init__(self) -> None:
        super().__init__(shaders.LOOK_UP, shaders.SKY)
        self.set_picture(np.zeros((1, 1, 3), np.float32))

    def set_camera(self, view: NDArray[np.float64], fov: float, aspect: float, to_sky: NDArray[np.float64]) -> None:
        """Set the camera.

        Args:
            view: [3,3], unit rows right, up and backward of the camera.
            fov: vertical field of view in degrees.
            aspect: width over height of the window.
            to_sky: [3,3], rotation from object space to the frame of the picture.
        """
        right, above, backward = view
        half = math.tan(math.radians(fov) / 2.0)
        self._set_vector("forward", -backward)
        self._set_vector("across", half * aspect * right)
        self._set_vector("above", half * above)
        self._set_sky_rotation(to_sky)


class Reference(_FullScreen):
    """A reference picture at its own size, scaled down to fit a smaller window."""

    def __init__(self, picture: NDArray[np.float32]) -> None:
        super().__init__("", shaders.PICTURE)
        self.actor.visibility = False
        self._size = picture.shape[1], picture.shape[0]
        self.set_picture(picture)

    def fit(self, width: int, height: int) -> None:
        """Fit the picture into a window of this size."""
        scale = min(1.0, width / self._size[0], height / self._size[1])
        self._uniforms.SetUniform2f("extent", [scale * self._size[0] / width, scale * self._size[1] / height])


class Object(Shaded):
    """The mesh, relative to its centre and in units of its radius, since VTK stores positions as float32."""

    def __init__(self, mesh: Mesh, interface: Interface | None) -> None:
        self.center = mesh.center
        self.radius = float(np.linalg.norm(mesh.positions - self.center, axis=1).max()) or 1.0
        scaled = ((mesh.positions - self.center) / self.radius).astype(np.float32)
        super().__init__(pv.PolyData.from_regular_faces(scaled, mesh.faces))
        self.mesh.point_data["colour"] = np.zeros((len(scaled), 4), np.float32)
        self.mesh.point_data["shadingNormal"] = mesh.normals.astype(np.float32)
        self.colours: Any = self.mesh.point_data["colour"]
        for name in ("colour", "shadingNormal"):
            points = vtkDataObject.FIELD_ASSOCIATION_POINTS
            self._mapper.MapDataArrayToVertexAttribute(f"{name}MC", name, points, -1)
        self._interface = interface
        self._reflects = False
        self._write_shader()

    def set_colours(self, colours: NDArray[np.float32]) -> None:
        """Set the weighted colours and weights of the vertices [V,4], as `Preview.colours` returns them."""
        self.colours[:] = colours

    def set_reflection(self, picture: NDArray[np.float32] | None) -> None:
        """Set the sky that the surface reflects, or none."""
        if picture is not None:
            self.set_picture(picture)
        if self._reflects is not (picture is not None):
            self._reflects = picture is not None
            if self._interface is not None:
                self._uniforms.SetUniform1fv("albedo", ALBEDOS, directional_albedo(self._interface).tolist())
            self._write_shader()

    def set_camera(self, eye: NDArray[np.float64], to_sky: NDArray[np.float64]) -> None:
        """Set the eye [3] of the reflection, in units of the object, and the rotation [3,3] to the sky's frame."""
        self._set_vector("eyeMC", eye)
        self._set_sky_rotation(to_sky)

    def cull_backfaces(self, hidden: bool) -> None:
        """Cull faces that turn away from the eye."""
        self.actor.prop.culling = "back" if hidden else "none"

    def _write_shader(self) -> None:
        """Write the shaders, without the code of the reflection if there is none."""
        self.actor.clear_shader_replacements()
        self._extend_vertex_shader(shaders.OBJECT_VERTEX_DECLARATIONS, shaders.OBJECT_VERTEX)
        declarations = shaders.OBJECT_DECLARATIONS + shaders.encode(self._tone_map)
        if self._reflects:
            declarations += shaders.LOOK_UP + shaders.REFLECTANCE
        reflection = shaders.OBJECT_REFLECTION if self._reflects else ""
        self._replace_fragment_shader(declarations, shaders.OBJECT + reflection + shaders.OBJECT_OUTPUT)
