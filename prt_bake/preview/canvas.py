"""What VTK draws on, in a window or in memory, and how a mouse moves the eye before it.

VTK's own modules are loaded one by one: all of them, or a library that loads them, would take as long as everything
else that a preview does before its first picture.
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
"""How much nearer or farther one step of the wheel takes the eye."""
_PLAIN = (0.13, 0.13, 0.14)
"""Behind an object without a sky, sRGB."""
_WHITE = (1.0, 1.0, 1.0)
_SLIDER_HEIGHT = 0.07
"""Share of the window's height."""
_KNOB, _TUBE = (0.015, 0.03), 0.006
"""Length along a slider and width across it, shares of the window: what a mouse hits without aim."""


class Canvas:
    """One renderer in one window: no light of VTK's, no tone mapping.

    Attributes:
        window, renderer, interactor: VTK's own.
    """

    def __init__(self, width: int, height: int, off_screen: bool, title: str = "prtbake") -> None:
        """off_screen: in memory; the window of the platform's otherwise, or in memory too where there is none."""
        # That there is no display is told in a sentence of our own, or does not matter.
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
        self.renderer: Any = vtkRenderer()
        self.renderer.AutomaticLightCreationOff()
        self.renderer.SetBackground(*_PLAIN)
        self.window: Any = vtkRenderWindow()
        self.window.SetOffScreenRendering(off_screen)
        self.window.SetSize(width, height)
        self.window.SetWindowName(title)
        self.window.AddRenderer(self.renderer)
        self.interactor: Any = vtkGenericRenderWindowInteractor() if off_screen else vtkRenderWindowInteractor()
        self.interactor.SetRenderWindow(self.window)

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
        self.window.Finalize()
        self.interactor.SetRenderWindow(None)

    def connect_mouse(self, moves: Callable[[], None]) -> None:
        """Let the mouse orbit about the vertical, the wheel go nearer, shift and the mouse go sideways; `moves` is
        called before each of these is drawn. No key of VTK's own does anything.
        """
        # Kept: VTK's hold on it does not keep what Python knows of it, which is what observers call.
        style: Any = vtkInteractorStyleTerrain()
        self._style = style

        def press(*_: Any) -> None:
            if self.interactor.GetShiftKey():
                style.StartPan()
            style.OnLeftButtonDown()

        def release(*_: Any) -> None:
            style.EndPan()
            style.OnLeftButtonUp()

        def roll(factor: float) -> Callable[..., None]:
            def do(*_: Any) -> None:
                moves()
                camera = self.camera
                camera.SetPosition(
                    *(
                        end + factor * (start - end)
                        for start, end in zip(camera.GetPosition(), camera.GetFocalPoint(), strict=True)
                    )
                )
                self.window.Render()

            return do

        style.AddObserver("LeftButtonPressEvent", press)
        style.AddObserver("LeftButtonReleaseEvent", release)
        style.AddObserver("MouseWheelForwardEvent", roll(1.0 / _WHEEL))
        style.AddObserver("MouseWheelBackwardEvent", roll(_WHEEL))
        style.AddObserver("CharEvent", lambda *_: None)
        style.AddObserver("StartInteractionEvent", lambda *_: moves())
        style.AddObserver("InteractionEvent", lambda *_: moves())
        self.interactor.SetInteractorStyle(style)

    def connect_keys(self, actions: dict[str, Callable[[], None]]) -> None:
        """Call what belongs to the name of a key (X11's) when it is pressed."""

        def pressed(*_: Any) -> None:
            action = actions.get(self.interactor.GetKeySym() or "")
            if action is not None:
                action()

        self.interactor.AddObserver("KeyPressEvent", pressed)

    def connect_drops(self, take: Callable[[list[str]], None]) -> None:
        """Call it with the paths of files that are dropped on the window."""

        def dropped(_caller: Any, _event: str, paths: Any) -> None:
            take([paths.GetValue(number) for number in range(paths.GetNumberOfValues())])

        self.interactor.AddObserver("DropFilesEvent", _calldata(VTK_OBJECT)(dropped))

    def slider(
        self, span: tuple[float, float], value: float, ends: tuple[float, float], slide: Callable[[float], None]
    ) -> Any:
        """A slider between two places across the window (shares of its width); `slide` is called as it moves."""
        shape: Any = vtkSliderRepresentation2D()
        shape.SetMinimumValue(span[0])
        shape.SetMaximumValue(span[1])
        shape.SetValue(value)
        for end, x in zip((shape.GetPoint1Coordinate(), shape.GetPoint2Coordinate()), ends, strict=True):
            end.SetCoordinateSystemToNormalizedDisplay()
            end.SetValue(x, _SLIDER_HEIGHT)
        for part in (shape.GetSliderProperty(), shape.GetCapProperty(), shape.GetTubeProperty()):
            part.SetColor(*_WHITE)
        shape.ShowSliderLabelOff()  # its format is another one from version to version of VTK
        shape.SetSliderLength(_KNOB[0])
        shape.SetSliderWidth(_KNOB[1])
        shape.SetTubeWidth(_TUBE)
        shape.SetEndCapLength(0.0)
        slider: Any = vtkSliderWidget()
        slider.SetInteractor(self.interactor)
        slider.SetCurrentRenderer(self.renderer)
        slider.SetRepresentation(shape)
        slider.On()
        slider.AddObserver("InteractionEvent", lambda *_: slide(shape.GetValue()))
        return slider
