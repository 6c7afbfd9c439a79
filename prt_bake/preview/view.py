"""The contents of the window. The object is shaded for the eye before each frame that the plotter draws."""

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import QueryError
from prt_bake.geometry import camera
from prt_bake.preview.actors import Object, Reference, Sky
from prt_bake.preview.state import Preview

_SAMPLES = 4
_PNG_LEVEL = 2
"""zlib level: a third of the default's time for a third more bytes."""


class View:
    """A preview drawn by a plotter.

    Attributes:
        plotter: the PyVista plotter.
        start: the initial camera.
        showing_reference: whether the reference picture is shown.
        changed: time of the last change by `time.monotonic`.
    """

    def __init__(
        self,
        preview: Preview,
        plotter: pv.Plotter,
        start: camera.Camera,
        reference: NDArray[np.float32] | None = None,
    ) -> None:
        """start: the initial camera, with the size of the plotter."""
        self.preview, self.plotter = preview, plotter
        self.start = start
        self._object, self._sky = Object(preview.asset.mesh, preview.interface), Sky()
        self._reference = None if reference is None else Reference(reference)
        self.showing_reference = False
        self.changed = -math.inf
        self._error = ""
        self._drawn: tuple[Any, ...] = ()
        self._motion: tuple[float, ...] = ()
        self._pictures: dict[str, NDArray[np.float32] | None] = {}
        # The object is drawn first, so that the depth test skips the sky behind it.
        for part in (self._object, self._sky, self._reference):
            if part is not None:
                plotter.add_actor(part.actor, reset_camera=False, pickable=False, render=False)
        self.smooth(True)
        self.reset_camera()
        plotter.render_window.AddObserver("StartEvent", lambda *_: self.update())

    @property
    def eye(self) -> NDArray[np.float64]:
        """Position of the camera in object space."""
        return self._object.center + self._object.radius * np.array(self.plotter.camera.position)

    @property
    def radius(self) -> float:
        """Length of a unit of VTK's space, in scene units."""
        return self._object.radius

    @property
    def colours(self) -> NDArray[np.float32]:
        """The vertex colours drawn last [V,4], as `Preview.colours` returns them."""
        colours: NDArray[np.float32] = self._object.colours
        return colours

    def reset_camera(self) -> None:
        """Return to the initial camera."""
        camera = self.plotter.camera
        camera.position = self._to_vtk(self.start.eye)
        camera.focal_point = self._to_vtk(self.start.target)
        camera.up = self.start.up
        camera.view_angle = self.start.fov

    def toggle_reference(self) -> None:
        """Toggle between the object and the reference picture."""
        self.showing_reference = self._reference is not None and not self.showing_reference

    def smooth(self, edges: bool) -> None:
        """Switch antialiasing, with which a frame takes several times as long."""
        if edges:
            self.plotter.enable_anti_aliasing("msaa", multi_samples=_SAMPLES)
        else:
            self.plotter.disable_anti_aliasing()

    @property
    def smooth_edges(self) -> bool:
        """Whether edges are antialiased."""
        return bool(self.plotter.render_window.GetMultiSamples())

    def refine(self, seconds: float = math.inf) -> bool:
        """Refine for about `seconds`; return whether it has just finished and must be drawn."""
        return not self.showing_reference and self.preview.refine(self.eye, seconds)

    @property
    def unrefined(self) -> bool:
        """Whether the refinement is unfinished."""
        return not self.showing_reference and self.preview.unrefined(self.eye)

    def settle(self) -> None:
        """Refine the view as it is now, with antialiased edges, until something moves."""
        self.update()
        self.smooth(True)
        self.refine()

    def picture(self) -> NDArray[np.uint8]:
        """Draw the window and return its pixels, sRGB [H,W,3], row 0 on top."""
        self.plotter.render()
        return np.asarray(self.plotter.screenshot(return_img=True))

    def update(self) -> None:
        """Update the actors if the camera or the preview has changed; what moves is not antialiased."""
        camera, size = self.plotter.camera, tuple(self.plotter.window_size)
        pose = (*camera.position, *camera.focal_point, *camera.up)
        motion = (*pose, self.preview.rotation, self.preview.exposure)
        state = (self.preview.changes, size, self.showing_reference, *motion)
        if state == self._drawn:
            return
        if self._motion and motion != self._motion:
            self.smooth(False)
        self._motion = motion
        self._drawn, self.changed = state, time.monotonic()
        self._update_actors(size)
        if self.showing_reference:
            return
        colours = self.shade()
        if colours is not None:
            self.upload(colours)
        self.plotter.reset_camera_clipping_range()
        self._update_cameras(size)

    def shade(self) -> NDArray[np.float32] | None:
        """Return the vertex colours for the eye; None, and the preview's message, if it sees nothing."""
        preview = self.preview
        try:
            colours = preview.colours(self.eye)
        except QueryError as error:
            self._error = preview.message = str(error)
            return None
        if preview.message == self._error:
            preview.message = ""
        return colours

    def upload(self, colours: NDArray[np.float32]) -> None:
        """Pass the vertex colours to the plotter."""
        self._object.set_colours(colours)

    def _update_actors(self, size: tuple[int, ...]) -> None:
        preview, reference = self.preview, self._reference
        sky = preview.sky
        self._object.actor.visibility = not self.showing_reference
        self._sky.actor.visibility = sky is not None and not self.showing_reference
        self._object.set_exposure(preview.shown_exposure, preview.shown_tone_map)
        self._sky.set_exposure(preview.exposure, preview.tone_map)
        if sky is not None and self._is_new("sky", sky):
            self._sky.set_picture(sky)
        reflected = preview.reflected_sky
        if self._is_new("reflected", reflected):
            self._object.set_reflection(reflected)
        if reference is not None:
            reference.actor.visibility = self.showing_reference
            reference.set_exposure(preview.exposure, preview.tone_map)
            reference.fit(size[0], size[1])

    def _update_cameras(self, size: tuple[int, ...]) -> None:
        camera, to_sky = self.plotter.camera, self.preview.to_sky
        view = pv.array_from_vtkmatrix(camera.GetViewTransformMatrix())[:3, :3]
        self._sky.set_camera(view, camera.view_angle, size[0] / size[1], to_sky)
        eye = np.array(camera.position)
        # The first picture, with smooth edges, does not test whether the object is closed, which takes time.
        self._object.cull_backfaces(not self.smooth_edges and float(np.linalg.norm(eye)) > 1.0 and self.preview.closed)
        if self.preview.reflected_sky is not None:
            self._object.set_camera(eye, to_sky)

    def _is_new(self, name: str, picture: NDArray[np.float32] | None) -> bool:
        """Whether this picture differs from the one at the previous call."""
        known = name in self._pictures and self._pictures[name] is picture
        self._pictures[name] = picture
        return not known

    def _to_vtk(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((point - self._object.center) / self._object.radius)


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write pixels, sRGB [H,W,3], as PNG, atomically."""
    from PIL import Image

    with replacing(path) as part:
        Image.fromarray(picture).save(part, format="PNG", compress_level=_PNG_LEVEL)
