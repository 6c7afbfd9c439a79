"""What is in the window: the object under its light, drawn anew for the eye whenever VTK draws."""

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util import numpy_support
from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

from formats.atomic import replacing
from formats.errors import QueryError
from prt_bake.geometry import camera
from prt_bake.preview.actors import Object, Reference, Sky
from prt_bake.preview.canvas import Canvas
from prt_bake.preview.state import Preview

vtk_to_numpy: Any = numpy_support.vtk_to_numpy
_SAMPLES = 4
_PACKED = 2
"""zlib's level of pictures: a third of the time of the usual one, for a third more bytes."""


class View:
    """A preview drawn on a canvas.

    Attributes:
        canvas: the window, or a picture in memory.
        window: the canvas's, as VTK has it.
        showing_reference: whether the picture to compare with is shown.
        changed: when something else was to be drawn than before, by `time.monotonic`.
    """

    def __init__(
        self,
        preview: Preview,
        canvas: Canvas,
        start: camera.Camera,
        reference: NDArray[np.float32] | None = None,
    ) -> None:
        """start: the camera to begin with; its size is that of the canvas."""
        self.preview, self.canvas = preview, canvas
        self.window = canvas.window
        self._start = start
        self._object, self._sky = Object(preview.asset.mesh, preview.interface), Sky()
        self._reference = None if reference is None else Reference(reference)
        self.showing_reference = False
        self.changed = -math.inf
        self._complaint = ""
        self._drawn: tuple[Any, ...] = ()
        self._pictures: dict[str, NDArray[np.float32] | None] = {}
        renderer = canvas.renderer
        renderer.RemoveCuller(renderer.GetCullers().GetLastItem())
        # The object first: what it hides of the sky is then never looked up.
        for part in (self._object, self._sky, self._reference):
            if part is not None:
                renderer.AddActor(part.actor)
        self.smooth(True)
        self.reset_camera()
        self.window.AddObserver("StartEvent", lambda *_: self.prepare())

    @property
    def eye(self) -> NDArray[np.float64]:
        """Where the camera is, in object space."""
        return self._object.center + self._object.radius * np.array(self._camera.GetPosition())

    @property
    def _camera(self) -> Any:
        return self.canvas.camera

    @property
    def radius(self) -> float:
        """A unit of VTK's space, in scene units."""
        return self._object.radius

    @property
    def shown(self) -> NDArray[np.float32]:
        """What the vertices were given last, as `Preview.colours` has it [V,4]."""
        return self._object.shown

    def reset_camera(self) -> None:
        """See the object as at the beginning."""
        camera = self._camera
        camera.SetPosition(*self._place(self._start.eye))
        camera.SetFocalPoint(*self._place(self._start.target))
        camera.SetViewUp(*self._start.up)
        camera.SetViewAngle(self._start.fov)

    def flip(self) -> None:
        """Show the picture to compare with, or the object again."""
        self.showing_reference = self._reference is not None and not self.showing_reference

    def smooth(self, edges: bool) -> None:
        """Draw smooth edges from now on, which takes several times as long."""
        self.window.SetMultiSamples(_SAMPLES if edges else 0)

    @property
    def smooth_edges(self) -> bool:
        """Whether edges are drawn smooth."""
        return bool(self.window.GetMultiSamples())

    def refine(self, seconds: float = math.inf) -> bool:
        """Go on meeting suns apart for about so long; whether that is done now, and to be drawn."""
        return not self.showing_reference and self.preview.refine(self.eye, seconds)

    @property
    def unrefined(self) -> bool:
        """Whether there is more of that to do."""
        return not self.showing_reference and self.preview.unrefined(self.eye)

    def picture(self) -> NDArray[np.uint8]:
        """What the window shows, sRGB [H,W,3], row 0 on top."""
        self.window.Render()
        grab = vtkWindowToImageFilter()
        grab.SetInput(self.window)
        grab.ReadFrontBufferOff()
        grab.ShouldRerenderOff()
        grab.Update()
        image = grab.GetOutput()
        width, height, _ = image.GetDimensions()
        pixels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, -1)
        return np.array(pixels[::-1, :, :3], np.uint8)

    def prepare(self) -> None:
        """Bring all that is drawn up to date with the camera and the preview; nothing where neither has changed."""
        preview = self.preview
        size = tuple(self.window.GetSize())
        now = (
            preview.changes,
            size,
            self.showing_reference,
            *self._camera.GetPosition(),
            *self._camera.GetFocalPoint(),
        )
        now = (*now, *self._camera.GetViewUp())
        if now == self._drawn:
            return
        self._drawn, self.changed = now, time.monotonic()
        self._show_parts(size)
        if self.showing_reference:
            return
        self._colour()
        self._look(size)

    def shade(self) -> NDArray[np.float32] | None:
        """The colours for the eye as it is; None where there are none, which the preview's message then says."""
        preview = self.preview
        try:
            colours = preview.colours(self.eye)
        except QueryError as fault:
            self._complaint = preview.message = str(fault)
            return None
        if preview.message == self._complaint:
            preview.message = ""
        return colours

    def upload(self, colours: NDArray[np.float32]) -> None:
        """Hand them to VTK."""
        self._object.set_colours(colours)

    def _colour(self) -> None:
        colours = self.shade()
        if colours is not None:
            self.upload(colours)
        self.canvas.renderer.ResetCameraClippingRange()

    def _show_parts(self, size: tuple[int, ...]) -> None:
        preview, reference = self.preview, self._reference
        sky = preview.sky
        self._object.actor.SetVisibility(not self.showing_reference)
        self._sky.actor.SetVisibility(sky is not None and not self.showing_reference)
        self._object.set_exposure(preview.shown_exposure)
        self._sky.set_exposure(preview.exposure)
        if sky is not None and self._new("sky", sky):
            self._sky.set_picture(sky)
        mirrored = preview.reflected_sky
        if self._new("mirrored", mirrored):
            self._object.set_reflection(mirrored)
        if reference is not None:
            reference.actor.SetVisibility(self.showing_reference)
            reference.set_exposure(preview.exposure)
            reference.fit(size[0], size[1])

    def _look(self, size: tuple[int, ...]) -> None:
        camera, to_sky = self._camera, self.preview.to_sky
        matrix = camera.GetViewTransformMatrix()
        view = np.array([[matrix.GetElement(row, column) for column in range(3)] for row in range(3)])
        self._sky.set_camera(view, camera.GetViewAngle(), size[0] / size[1], to_sky)
        eye = np.array(camera.GetPosition())
        # Whether the object is closed is not asked for the first picture, which can wait for its backs.
        self._object.cull_backfaces(not self.smooth_edges and float(np.linalg.norm(eye)) > 1.0 and self.preview.closed)
        if self.preview.reflected_sky is not None:
            self._object.set_camera(eye, to_sky)

    def _new(self, name: str, picture: NDArray[np.float32] | None) -> bool:
        """Whether this is another picture than the one handed over before."""
        known = name in self._pictures and self._pictures[name] is picture
        self._pictures[name] = picture
        return not known

    def _place(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((point - self._object.center) / self._object.radius)


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write what a window showed, sRGB [H,W,3], as PNG, whole or not at all."""
    from PIL import Image

    with replacing(path) as part:
        Image.fromarray(picture).save(part, format="PNG", compress_level=_PACKED)
