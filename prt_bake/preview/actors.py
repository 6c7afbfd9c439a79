"""The three things that VTK draws: the object, the sky behind it, and a picture to compare with.

None of them is lit by VTK: what is drawn is linear radiance, and `prt_bake.preview.shaders` encodes it.
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
    """Something drawn by a shader of ours, which reads one picture."""

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
        """Show it with an exposure in EV."""
        self._uniforms.SetUniformf("gain", 2.0 ** max(exposure, _LEAST_GAIN))

    def set_picture(self, picture: NDArray[np.float32]) -> None:
        """Read this picture [H,W,3], linear, row 0 on top, from now on."""
        self._pixels = np.ascontiguousarray(picture, np.float32)  # VTK keeps no reference of its own
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

    def _turn_sky(self, to_sky: NDArray[np.float64]) -> None:
        matrix = vtkMatrix3x3()
        matrix.DeepCopy(to_sky.T.ravel().tolist())  # GLSL counts by columns
        self._uniforms.SetUniformMatrix("toSky", matrix)

    def _replace_vertex(self, names: str, code: str) -> None:
        for place, words in (("//VTK::PositionVC::Dec", names), ("//VTK::PositionVC::Impl", code)):
            self._shader.AddVertexShaderReplacement(place, True, f"{place}\n{words}", False)

    def _replace_fragment(self, names: str, code: str) -> None:
        # Names follow that of the picture, which VTK declares here; code, all that VTK itself would colour by.
        place = "//VTK::TCoord::Dec"
        self._shader.AddFragmentShaderReplacement(place, True, f"{place}\n{names}", False)
        self._shader.AddFragmentShaderReplacement("//VTK::TCoord::Impl", True, code, False)


class Sky(Actor):
    """What lies behind the object, however far the eye is."""

    def __init__(self) -> None:
        super().__init__(_full_screen())
        self.actor.UseBoundsOff()
        self._shader.AddVertexShaderReplacement("//VTK::PositionVC::Impl", True, shaders.FULL_SCREEN, False)
        self._replace_fragment(shaders.ENCODE + shaders.LOOK_UP, shaders.SKY)
        self.set_picture(np.zeros((1, 1, 3), np.float32))

    def set_camera(self, view: NDArray[np.float64], fov: float, aspect: float, to_sky: NDArray[np.float64]) -> None:
        """Draw what is seen along the rows right, above and backward of `view` [3,3], unit, with a vertical field of
        view `fov` in degrees, turned by `to_sky` [3,3] to the frame of the picture.
        """
        right, above, backward = view
        half = math.tan(math.radians(fov) / 2.0)
        self._set_vector("forward", -backward)
        self._set_vector("across", half * aspect * right)
        self._set_vector("above", half * above)
        self._turn_sky(to_sky)


class Reference(Actor):
    """A picture at its own size, smaller where the window has no room for it."""

    def __init__(self, picture: NDArray[np.float32]) -> None:
        super().__init__(_full_screen())
        self.actor.UseBoundsOff()
        self.actor.VisibilityOff()
        self._size = picture.shape[1], picture.shape[0]
        self._shader.AddVertexShaderReplacement("//VTK::PositionVC::Impl", True, shaders.FULL_SCREEN, False)
        self._replace_fragment(shaders.ENCODE, shaders.PICTURE)
        self.set_picture(picture)

    def fit(self, width: int, height: int) -> None:
        """Draw it in a window of this size."""
        scale = min(1.0, width / self._size[0], height / self._size[1])
        self._uniforms.SetUniform2f("extent", [scale * self._size[0] / width, scale * self._size[1] / height])


class Object(Actor):
    """The mesh, about its middle and in units of its size: VTK keeps positions as float32."""

    def __init__(self, mesh: Mesh, interface: Interface | None) -> None:
        self.center = mesh.center
        self.radius = float(np.linalg.norm(mesh.positions - self.center, axis=1).max()) or 1.0
        geometry = _triangles((mesh.positions - self.center) / self.radius, mesh.faces)
        self.shown = np.zeros((len(mesh.positions), 4), np.float32)
        self._shown = _named(numpy_to_vtk(self.shown), "shown")
        geometry.GetPointData().AddArray(self._shown)
        geometry.GetPointData().AddArray(_named(numpy_to_vtk(mesh.normals.astype(np.float32), deep=True), "bent"))
        super().__init__(geometry)
        points = vtkDataObject.FIELD_ASSOCIATION_POINTS
        self.mapper.MapDataArrayToVertexAttribute("shownMC", "shown", points, -1)
        self.mapper.MapDataArrayToVertexAttribute("bentMC", "bent", points, -1)
        self._replace_vertex(shaders.OBJECT_VERTEX_NAMES, shaders.OBJECT_VERTEX)
        self._uniforms.SetUniformf("eta", 1.0 if interface is None else interface.eta)
        self._mirrors = False
        self._write()

    def set_colours(self, shown: NDArray[np.float32]) -> None:
        """Give the vertices colours times shares, and shares [V,4]."""
        self.shown[:] = shown
        self._shown.Modified()

    def set_reflection(self, picture: NDArray[np.float32] | None) -> None:
        """Reflect this sky at the surface, or none."""
        if picture is not None:
            self.set_picture(picture)
        if self._mirrors is not (picture is not None):
            self._mirrors = picture is not None
            self._write()

    def set_camera(self, eye: NDArray[np.float64], to_sky: NDArray[np.float64]) -> None:
        """Reflect the sky, turned by `to_sky` [3,3], to this eye, in units of the object."""
        self._set_vector("eyeMC", eye)
        self._turn_sky(to_sky)

    def cull_backfaces(self, hidden: bool) -> None:
        """Leave out faces that turn away: in front of them lie others, which would be worked out as well."""
        self.actor.GetProperty().SetBackfaceCulling(hidden)

    def _write(self) -> None:
        """Another program with reflection than without: what is not wanted is not worked out for each pixel."""
        self._shader.ClearAllFragmentShaderReplacements()
        names = shaders.OBJECT_NAMES + shaders.ENCODE
        if self._mirrors:
            names += shaders.LOOK_UP + shaders.REFLECTANCE
        mirrors = shaders.OBJECT_MIRRORS if self._mirrors else ""
        self._replace_fragment(names, shaders.OBJECT + mirrors + shaders.OBJECT_SHOWN)


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
    places = numpy_to_vtk((0.5 + 0.5 * corners[:, :2]).astype(np.float32), deep=True)
    geometry.GetPointData().SetTCoords(_named(places, "places"))
    return geometry


def _named(array: Any, name: str) -> Any:
    array.SetName(name)
    return array
