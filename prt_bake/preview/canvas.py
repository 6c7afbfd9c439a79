"""What PyVista draws on, in a window or in memory, and how a mouse moves the eye before it."""

from collections.abc import Callable
from typing import Any

import pyvista
from vtkmodules.util.misc import calldata_type
from vtkmodules.util.vtkConstants import VTK_OBJECT
from vtkmodules.vtkCommonCore import vtkLogger

_told: Any = calldata_type
_plotter: Any = pyvista.Plotter
_PLAIN = (0.13, 0.13, 0.14)
"""Behind an object without a sky, sRGB."""
_SLIDER_HEIGHT = 0.07
"""Share of the window's height."""
_KNOB, _TUBE = (0.015, 0.03), 0.006
"""Length along a slider and width across it, shares of the window: what a mouse hits without aim."""


class Canvas:
    """One renderer in one window: no light of VTK's, no tone mapping.

    Attributes:
        plotter: PyVista's.
        window, renderer, interactor: VTK's own.
    """

    def __init__(self, width: int, height: int, off_screen: bool, title: str = "prtbake") -> None:
        """off_screen: in memory; the window of the platform's otherwise, or in memory too where there is none."""
        # That there is no display is told in a sentence of our own, or does not matter.
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
        self.plotter = _plotter(off_screen=off_screen, window_size=[width, height], lighting="none", title=title)
        self.window: Any = self.plotter.render_window
        self.renderer: Any = self.plotter.renderer
        self.interactor: Any = self.plotter.iren.interactor
        self.renderer.SetBackground(*_PLAIN)
        self.renderer.camera_set = True  # else PyVista looks for one of its own

    @property
    def camera(self) -> Any:
        """The eye."""
        return self.renderer.GetActiveCamera()

    @property
    def on_display(self) -> bool:
        """Whether the window can be seen: VTK makes one in memory where it finds no display."""
        return not self.window.GetClassName().startswith(("vtkEGL", "vtkOSOpenGL"))

    def open(self) -> None:
        """Open the window, empty: a tenth of a second that needs nothing of what will be in it."""
        self.window.Render()

    def resize(self, width: int, height: int) -> None:
        """Change its size in pixels."""
        if (width, height) != tuple(self.window.GetSize()):
            self.window.SetSize(width, height)

    def close(self) -> None:
        """Give back what the window holds on the graphics card."""
        self.plotter.close()

    def move_by_mouse(self, moves: Callable[[], None]) -> None:
        """Let the mouse orbit about the vertical, the wheel go nearer, shift and the mouse go sideways; `moves` is
        called before each of these is drawn. No key of VTK's own does anything.
        """
        self.plotter.iren.clear_key_event_callbacks()
        self.plotter.iren.enable_terrain_style(mouse_wheel_zooms=True, shift_pans=True)
        style = self.interactor.GetInteractorStyle()
        style.AddObserver("CharEvent", lambda *_: None)  # in place of VTK's own keys
        for event in ("StartInteractionEvent", "InteractionEvent"):
            style.AddObserver(event, lambda *_: moves())
        for event in ("MouseWheelForwardEvent", "MouseWheelBackwardEvent"):
            style.AddObserver(event, lambda *_: moves(), 1.0)  # before PyVista's, which draws

    def listen(self, actions: dict[str, Callable[[], None]]) -> None:
        """Call what belongs to the name of a key (X11's) when it is pressed."""
        for name, action in actions.items():
            self.plotter.add_key_event(name, action)

    def take_files(self, take: Callable[[list[str]], None]) -> None:
        """Call it with the paths of files that are dropped on the window."""

        def dropped(_caller: Any, _event: str, paths: Any) -> None:
            take([paths.GetValue(number) for number in range(paths.GetNumberOfValues())])

        self.interactor.AddObserver("DropFilesEvent", _told(VTK_OBJECT)(dropped))

    def slider(
        self, span: tuple[float, float], value: float, ends: tuple[float, float], slide: Callable[[float], None]
    ) -> Any:
        """A slider between two places across the window (shares of its width); `slide` is called as it moves."""
        left, right = ends
        slider: Any = self.plotter.add_slider_widget(
            slide,
            span,
            value=value,
            title="",
            pointa=(left, _SLIDER_HEIGHT),
            pointb=(right, _SLIDER_HEIGHT),
            color="white",
            interaction_event="always",
            slider_width=_KNOB[1],
            tube_width=_TUBE,
        )
        shape = slider.GetRepresentation()
        shape.ShowSliderLabelOff()  # its format is another one from version to version of VTK
        shape.SetSliderLength(_KNOB[0])
        shape.SetEndCapLength(0.0)
        return slider
