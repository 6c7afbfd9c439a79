"""The VTK window, on the display or in memory, with its camera controls.

Imports only the VTK modules it uses: importing all of VTK would double the time to the first picture.
"""

from collections.abc import Callable
from typing import Any

import vtkmodules.vtkRenderingFreeType
import vtkmodules.vtkRenderingOpenGL2
import vtkmodules.vtkRenderingUI  # noqa: F401 (windows of the platform)
from vtkmodules.util.misc import calldata_type
from vtkmodules.util.vtkConstants import VTK_OBJECT
from vtkmodules.vtkCommonCore import vtkLogger
from vtkmodules.vtkInteractionStyle import vtkInteractorStyleTerrain
from vtkmodules.vtkInteractionWidgets import vtkSliderRepresentation2D, vtkSliderWidget
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkRenderWindowInteractor
from vtkmodules.vtkRenderingUI import vtkGenericRenderWindowInteractor

_calldata: Any = calldata_type
_WHEEL = 1.05
"""Factor on the eye's distance per step of the wheel."""
_BACKGROUND = (0.13, 0.13, 0.14)
"""Background without a sky, sRGB."""
_WHITE = (1.0, 1.0, 1.0)
_SLIDER_HEIGHT = 0.07
"""Relative to the window's height."""
_KNOB, _TUBE = (0.015, 0.03), 0.006
"""Length and width of a slider's knob, and width of its tube, relative to the window."""


class Canvas:
    """A window with one renderer, without VTK's lights and tone mapping.

    Attributes:
        window, renderer, interactor: the VTK objects.
    """

    def __init__(self, width: int, height: int, off_screen: bool, title: str = "prtbake") -> None:
        """off_screen: draw in memory. Otherwise opens a window, or draws in memory if there is no display."""
        # VTK warns if there is no display; our callers report that themselves.
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
        self.renderer: Any = vtkRenderer()
        self.renderer.AutomaticLightCreationOff()
        self.renderer.SetBackground(*_BACKGROUND)
        self.window: Any = vtkRenderWindow()
        self.window.SetOffScreenRendering(off_screen)
        self.window.SetSize(width, height)
        self.window.SetWindowName(title)
        self.window.AddRenderer(self.renderer)
        self.interactor: Any = vtkGenericRenderWindowInteractor() if off_screen else vtkRenderWindowInteractor()
        self.interactor.SetRenderWindow(self.window)

    @property
    def camera(self) -> Any:
        """The VTK camera."""
        return self.renderer.GetActiveCamera()

    @property
    def on_display(self) -> bool:
        """Whether the window is visible; without a display VTK makes one in memory."""
        return not self.window.GetClassName().startswith(("vtkEGL", "vtkOSOpenGL"))

    def open(self) -> None:
        """Open the empty window, which takes 0.1 s and can overlap with reading the asset."""
        self.window.Render()

    def resize(self, width: int, height: int) -> None:
        """Set the size in pixels."""
        if (width, height) != tuple(self.window.GetSize()):
            self.window.SetSize(width, height)

    def close(self) -> None:
        """Release the window's GPU resources."""
        self.window.Finalize()
        self.interactor.SetRenderWindow(None)

    def connect_mouse(self, on_move: Callable[[], None]) -> None:
        """Let the mouse orbit, the wheel zoom and shift with the mouse pan; VTK's own keys do nothing.

        `on_move` is called before each movement is drawn.
        """
        style: Any = vtkInteractorStyleTerrain()
        self._style = style  # VTK keeps the object alive, but not its Python observers

        def press(*_: Any) -> None:
            if self.interactor.GetShiftKey():
                style.StartPan()
            style.OnLeftButtonDown()

        def release(*_: Any) -> None:
            style.EndPan()
            style.OnLeftButtonUp()

        def zoom(factor: float) -> Callable[..., None]:
            def handle(*_: Any) -> None:
                on_move()
                camera = self.camera
                eye, target = camera.GetPosition(), camera.GetFocalPoint()
                camera.SetPosition(*(t + factor * (e - t) for e, t in zip(eye, target, strict=True)))
                self.window.Render()

            return handle

        style.AddObserver("LeftButtonPressEvent", press)
        style.AddObserver("LeftButtonReleaseEvent", release)
        style.AddObserver("MouseWheelForwardEvent", zoom(1.0 / _WHEEL))
        style.AddObserver("MouseWheelBackwardEvent", zoom(_WHEEL))
        style.AddObserver("CharEvent", lambda *_: None)
        style.AddObserver("StartInteractionEvent", lambda *_: on_move())
        style.AddObserver("InteractionEvent", lambda *_: on_move())
        self.interactor.SetInteractorStyle(style)

    def connect_keys(self, actions: dict[str, Callable[[], None]]) -> None:
        """Call `actions[name]` when the key with this X11 name is pressed."""

        def pressed(*_: Any) -> None:
            action = actions.get(self.interactor.GetKeySym() or "")
            if action is not None:
                action()

        self.interactor.AddObserver("KeyPressEvent", pressed)

    def connect_drops(self, on_drop: Callable[[list[str]], None]) -> None:
        """Call `on_drop` with the paths of files that are dropped on the window."""

        def dropped(_caller: Any, _event: str, paths: Any) -> None:
            on_drop([paths.GetValue(number) for number in range(paths.GetNumberOfValues())])

        self.interactor.AddObserver("DropFilesEvent", _calldata(VTK_OBJECT)(dropped))

    def slider(
        self, span: tuple[float, float], value: float, ends: tuple[float, float], on_change: Callable[[float], None]
    ) -> Any:
        """Add a slider over `span` from left to right end, relative to the window's width."""
        shape: Any = vtkSliderRepresentation2D()
        shape.SetMinimumValue(span[0])
        shape.SetMaximumValue(span[1])
        shape.SetValue(value)
        for end, x in zip((shape.GetPoint1Coordinate(), shape.GetPoint2Coordinate()), ends, strict=True):
            end.SetCoordinateSystemToNormalizedDisplay()
            end.SetValue(x, _SLIDER_HEIGHT)
        for part in (shape.GetSliderProperty(), shape.GetCapProperty(), shape.GetTubeProperty()):
            part.SetColor(*_WHITE)
        shape.ShowSliderLabelOff()  # its format differs between versions of VTK
        shape.SetSliderLength(_KNOB[0])
        shape.SetSliderWidth(_KNOB[1])
        shape.SetTubeWidth(_TUBE)
        shape.SetEndCapLength(0.0)
        slider: Any = vtkSliderWidget()
        slider.SetInteractor(self.interactor)
        slider.SetCurrentRenderer(self.renderer)
        slider.SetRepresentation(shape)
        slider.On()
        slider.AddObserver("InteractionEvent", lambda *_: on_change(shape.GetValue()))
        return slider
