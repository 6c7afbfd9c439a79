"""The actors that VTK draws: the object, the sky behind it, and a reference picture.

VTK lights none of them: they show linear radiance, which `prt_bake.preview.shaders` encodes as sRGB.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util import numpy_support
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkDataObject, vtkImageData, vtkPolyData
from vtkmodules.vtkCommonMath import vtkMatrix3x3
from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkTexture

from formats.mesh import Mesh
from prt_bake.preview import shaders
from prt_bake.preview.state import Interface

numpy_to_vtk: Any = numpy_support.numpy_to_vtk
_LEAST_GAIN = -126.0


class Actor:
    """An actor with our shader and one picture as its texture."""

    def __init__(self, geometry: vtkPolyData) -> None:
        self.mapper = vtkPolyDataMapper()
        self.mapper.SetInputData(geometry)
        self.mapper.ScalarVisibilityOff()
        self.actor = vtkActor()
        self.actor.SetMapper(self.mapper)
        self._shader: Any = self.actor.GetShaderProperty()
        self._uniforms: Any = self._shader.GetFragmentCustomUniforms()
        self._pixels: NDArray[np.float32] | None = None
        self.set_exposure(0.0)

    def set_exposure(self, exposure: float) -> None:
        """Set the exposure in EV."""
        self._uniforms.SetUniformf("gain", 2.0 ** max(exposure, _LEAST_GAIN))

    def set_picture(self, picture: NDArray[np.float32]) -> None:
        """Set the texture to a linear picture [H,W,3], row 0 on top."""
        self._pixels = np.ascontiguousarray(picture, np.float32)  # VTK does not own the array
        height, width = picture.shape[:2]
        image = vtkImageData()
        image.SetDimensions(width, height, 1)
        image.GetPointData().SetScalars(numpy_to_vtk(self._pixels.reshape(-1, 3)))
        texture = vtkTexture()
        texture.SetInputData(image)
        texture.SetColorModeToDirectScalars()
        texture.InterpolateOn()
        texture.MipmapOff()
        texture.SetWrap(vtkTexture.Repeat)
        self.actor.SetTexture(texture)
        self._uniforms.SetUniformf("halfRow", 0.5 / height)

    def _set_vector(self, name: str, vector: NDArray[np.float64]) -> None:
        self._uniforms.SetUniform3f(name, vector.tolist())

    def _set_sky_rotation(self, to_sky: NDArray[np.float64]) -> None:
        matrix = vtkMatrix3x3()
        matrix.DeepCopy(to_sky.T.ravel().tolist())  # GLSL matrices are column-major
        self._uniforms.SetUniformMatrix("toSky", matrix)

    def _extend_vertex_shader(self, declarations: str, code: str) -> None:
        for tag, text in (("//VTK::PositionVC::Dec", declarations), ("//VTK::PositionVC::Impl", code)):
            self._shader.AddVertexShaderReplacement(tag, True, f"{tag}\n{text}", False)

    def _replace_fragment_shader(self, declarations: str, code: str) -> None:
        # VTK declares the texture at this tag, so our declarations follow it. The code replaces all of VTK's colouring.
        tag = "//VTK::TCoord::Dec"
        self._shader.AddFragmentShaderReplacement(tag, True, f"{tag}\n{declarations}", False)
        self._shader.AddFragmentShaderReplacement("//VTK::TCoord::Impl", True, code, False)


class Sky(Actor):
    """The sky behind the object, at infinity."""

    def __init__(self) -> None:
        super().__init__(_full_screen())
        self.actor.UseBoundsOff()
        self._shader.AddVertexShaderReplacement("//VTK::PositionVC::Impl", True, shaders.FULL_SCREEN, False)
        self._replace_fragment_shader(shaders.ENCODE + shaders.LOOK_UP, shaders.SKY)
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


class Reference(Actor):
    """A reference picture at its own size, scaled down to fit a smaller window."""

    def __init__(self, picture: NDArray[np.float32]) -> None:
        super().__init__(_full_screen())
        self.actor.UseBoundsOff()
        self.actor.VisibilityOff()
        self._size = picture.shape[1], picture.shape[0]
        self._shader.AddVertexShaderReplacement("//VTK::PositionVC::Impl", True, shaders.FULL_SCREEN, False)
        self._replace_fragment_shader(shaders.ENCODE, shaders.PICTURE)
        self.set_picture(picture)

    def fit(self, width: int, height: int) -> None:
        """Fit the picture into a window of this size."""
        scale = min(1.0, width / self._size[0], height / self._size[1])
        self._uniforms.SetUniform2f("extent", [scale * self._size[0] / width, scale * self._size[1] / height])


class Object(Actor):
    """The mesh, relative to its centre and in units of its radius, since VTK stores positions as float32."""

    def __init__(self, mesh: Mesh, interface: Interface | None) -> None:
        self.center = mesh.center
        self.radius = float(np.linalg.norm(mesh.positions - self.center, axis=1).max()) or 1.0
        geometry = _triangles((mesh.positions - self.center) / self.radius, mesh.faces)
        self.colours = np.zeros((len(mesh.positions), 4), np.float32)
        self._colours = _named(numpy_to_vtk(self.colours), "colour")
        normals = _named(numpy_to_vtk(mesh.normals.astype(np.float32), deep=True), "shadingNormal")
        geometry.GetPointData().AddArray(self._colours)
        geometry.GetPointData().AddArray(normals)
        super().__init__(geometry)
        points = vtkDataObject.FIELD_ASSOCIATION_POINTS
        self.mapper.MapDataArrayToVertexAttribute("colourMC", "colour", points, -1)
        self.mapper.MapDataArrayToVertexAttribute("shadingNormalMC", "shadingNormal", points, -1)
        self._extend_vertex_shader(shaders.OBJECT_VERTEX_DECLARATIONS, shaders.OBJECT_VERTEX)
        self._uniforms.SetUniformf("eta", 1.0 if interface is None else interface.eta)
        self._reflects = False
        self._write_shader()

    def set_colours(self, colours: NDArray[np.float32]) -> None:
        """Set the weighted colours and weights of the vertices [V,4], as `Preview.colours` returns them."""
        self.colours[:] = colours
        self._colours.Modified()

    def set_reflection(self, picture: NDArray[np.float32] | None) -> None:
        """Set the sky that the surface reflects, or none."""
        if picture is not None:
            self.set_picture(picture)
        if self._reflects is not (picture is not None):
            self._reflects = picture is not None
            self._write_shader()

    def set_camera(self, eye: NDArray[np.float64], to_sky: NDArray[np.float64]) -> None:
        """Set the eye [3] of the reflection, in units of the object, and the rotation [3,3] to the sky's frame."""
        self._set_vector("eyeMC", eye)
        self._set_sky_rotation(to_sky)

    def cull_backfaces(self, hidden: bool) -> None:
        """Cull faces that turn away from the eye."""
        self.actor.GetProperty().SetBackfaceCulling(hidden)

    def _write_shader(self) -> None:
        """Write the fragment shader, without the code of the reflection if there is none."""
        self._shader.ClearAllFragmentShaderReplacements()
        declarations = shaders.OBJECT_DECLARATIONS + shaders.ENCODE
        if self._reflects:
            declarations += shaders.LOOK_UP + shaders.REFLECTANCE
        reflection = shaders.OBJECT_REFLECTION if self._reflects else ""
        self._replace_fragment_shader(declarations, shaders.OBJECT + reflection + shaders.OBJECT_OUTPUT)


def _triangles(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> vtkPolyData:
    points = vtkPoints()
    points.SetData(numpy_to_vtk(positions.astype(np.float32), deep=True))
    cells = vtkCellArray()
    offsets = 3 * np.arange(len(faces) + 1, dtype=np.int64)
    cells.SetData(numpy_to_vtk(offsets, deep=True), numpy_to_vtk(faces.astype(np.int64).ravel(), deep=True))
    geometry = vtkPolyData()
    geometry.SetPoints(points)
    geometry.SetPolys(cells)
    return geometry


def _full_screen() -> vtkPolyData:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
    geometry = _triangles(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    uv = numpy_to_vtk((0.5 + 0.5 * corners[:, :2]).astype(np.float32), deep=True)
    geometry.GetPointData().SetTCoords(_named(uv, "uv"))
    return geometry


def _named(array: Any, name: str) -> Any:
    array.SetName(name)
    return array
