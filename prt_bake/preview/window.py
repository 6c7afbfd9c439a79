"""The window: keys, sliders, and a timer that reloads changed lights and refines the picture."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vtkmodules.util.misc import calldata_type
from vtkmodules.util.vtkConstants import VTK_OBJECT

from formats.errors import PrtbakeError
from formats.interrupts import interrupt_flag
from prt_bake.preview import legend, reasons
from prt_bake.preview.overlay import SLIDERS, Overlay
from prt_bake.preview.plotter import on_display, open_plotter, watching_for_destruction
from prt_bake.preview.state import Mode, Preview, Scale
from prt_bake.preview.view import View, write_picture

__all__ = ["View", "Window", "on_display", "open_plotter", "write_picture"]

_calldata: Any = calldata_type
TICK = 100
"""Milliseconds between two events of the timer."""
SLIDER_EXPOSURE = 4.0
"""EV at the ends of the slider; keys go on."""
_ROTATION_STEP, _EXPOSURE_STEP = 5.0, 0.5
"""Degrees and EV per key press."""
_MESSAGE_SECONDS = 6.0
"""Seconds that a message stays."""
_STILL = 0.2
"""Seconds after the last movement until edges are antialiased and suns are refined."""
_SLICE, _PAUSE = 0.02, 1
"""Seconds of a slice of refinement, and milliseconds for the user's events until the next one."""
_SLIDER_HEIGHT, _SLIDER_TOP, _KNOB, _TUBE = 0.07, 0.1, (0.015, 0.03), 0.006
"""Height of the sliders and of their upper ends, length and width of a knob, and width of a tube, relative to the
window."""
_TUBE_GREY = 0.4, 0.4, 0.4


class Window:
    """A view with keys, mouse, sliders and texts; `run` shows it to the user.

    Attributes:
        view: the picture.
        plotter: the PyVista plotter that draws it.
        overlay: the texts over it.
        rotation, exposure: the sliders; `rotation` is off for an asset made for one light.
    """

    def __init__(self, view: View, name: str, reference: str | None = None) -> None:
        """name: of the asset. reference: name of the reference picture."""
        self.view, self._name, self._reference = view, name, reference
        self._preview: Preview = view.preview
        self.plotter: Any = view.plotter
        self.overlay = Overlay(self.plotter)
        self._legend = self._saving = self._loading = False
        self._message_time = -math.inf
        self._scale: Scale | None = None
        self._interrupted: Callable[[], int] = lambda: 0
        self._destroyed: Callable[[], bool] = lambda: False
        self.interrupted = 0
        self._connect()
        self.rotation = self._slider((-180.0, 180.0), 0, self._preview.rotate_to)
        self.exposure = self._slider((-SLIDER_EXPOSURE, SLIDER_EXPOSURE), 1, self._preview.set_exposure)
        self._update_texts()

    def run(self) -> None:
        """Show the window until the user closes it, or a signal, whose number `interrupted` is then."""
        # A KeyboardInterrupt inside VTK's event loop would end the process with VTK's own message.
        with interrupt_flag() as self._interrupted, watching_for_destruction(self.plotter) as self._destroyed:
            self.plotter.iren.initialize()
            self.render()
            self._preview.load_in_background()
            self.plotter.iren.create_timer(TICK)
            self.plotter.show()
            self.interrupted = self._interrupted()

    def render(self) -> None:
        """Draw the picture, texts and sliders."""
        self.plotter.render()
        self._update_message()

    def tick(self) -> None:
        """Handle the timer: end after Ctrl-C or without a window, reload lights, drop old messages, refine."""
        if self._interrupted() or self._destroyed():
            self._quit()
            return
        now = time.monotonic()
        changed = self._preview.reload_lights()
        if not changed and self._preview.message and now - self._message_time > _MESSAGE_SECONDS:
            self._preview.message = ""
            changed = True
        if self._loading is not self._preview.loading:
            self._loading = self._preview.loading
            changed = True
        still = now - self.view.changed > _STILL
        if not self.view.smooth_edges and still:
            self.view.smooth(True)
            changed = True
        if still and self.view.unrefined:
            changed |= self.view.refine(_SLICE)
            self.plotter.iren.create_timer(_PAUSE, repeating=False)
        if changed:
            self.render()

    def save(self, path: Path) -> None:
        """Write the refined picture as PNG, without texts and sliders."""
        texts = self.overlay.hide()
        sliders = [slider for slider in (self.rotation, self.exposure) if slider.GetEnabled()]
        for slider in sliders:
            slider.Off()
        self.view.settle()
        self._saving = True
        try:
            write_picture(path, self.view.picture())
        finally:
            self._saving = False
            self.overlay.restore(texts)
            for slider in sliders:
                slider.On()

    def _connect(self) -> None:
        plotter = self.plotter
        plotter.enable_terrain_style(mouse_wheel_zooms=True, shift_pans=True)
        style = plotter.iren.style
        for event in ("CharEvent", "TimerEvent"):  # VTK's own keys do nothing, and its timer would go on with a drag
            style.add_observer(event, lambda *_: None)
        # After a pan the style would keep all events to itself, and the sliders would get none.
        style.add_observer("EndInteractionEvent", lambda *_: style.ReleaseFocus())
        plotter.iren.clear_key_event_callbacks()  # nor PyVista's
        for keys, action in self._actions():
            for key in keys.split():
                plotter.add_key_event(key, self._handler(action))
        plotter.iren.add_observer("TimerEvent", lambda *_: self.tick())
        dropped = _calldata(VTK_OBJECT)(lambda _caller, _event, paths: self._add_lights(paths))
        plotter.iren.interactor.AddObserver("DropFilesEvent", dropped)
        plotter.render_window.AddObserver("StartEvent", lambda *_: self._update_texts())

    def _actions(self) -> list[tuple[str, Callable[[], None]]]:
        preview = self._preview
        return [
            ("h question", self._toggle_legend),
            ("0 Home", self.view.reset_camera),
            ("Up", lambda: preview.set_exposure(preview.exposure + _EXPOSURE_STEP)),
            ("Down", lambda: preview.set_exposure(preview.exposure - _EXPOSURE_STEP)),
            ("Left", self._unless(reasons.of_rotation, lambda: preview.rotate_to(preview.rotation - _ROTATION_STEP))),
            ("Right", self._unless(reasons.of_rotation, lambda: preview.rotate_to(preview.rotation + _ROTATION_STEP))),
            ("n", self._unless(reasons.of_other_lights, preview.step_light)),
            ("N", self._unless(reasons.of_other_lights, lambda: preview.step_light(-1))),
            ("r", self._unless(reasons.of_reflection, preview.toggle_reflection)),
            ("b", self._unless(reasons.of_background, preview.toggle_background)),
            ("u", self._unless(reasons.of_suns, preview.toggle_suns)),
            ("t", self._unless(reasons.of_tone_map, preview.toggle_tone_map)),
            ("e", lambda: preview.show(Mode.ERROR)),
            ("v", lambda: preview.show(Mode.VALID)),
            ("c", lambda: preview.show(Mode.COEFFICIENT)),
            ("period greater", lambda: preview.step_harmonic(1)),
            ("comma less", lambda: preview.step_harmonic(-1)),
            ("space", self._flip),
            ("s", self._save_numbered),
            ("q Escape", self._quit),
        ]

    def _unless(self, reason: Callable[[Preview], str], action: Callable[[], None]) -> Callable[[], None]:
        """Return the action, which leaves a message instead where there is a reason why it would change nothing."""

        def act() -> None:
            preview = self._preview
            if self.view.showing_reference:
                preview.message = "the reference picture is shown: space returns to the object"
            elif text := reason(preview):
                preview.message = text
            else:
                action()

        return act

    def _handler(self, action: Callable[[], None]) -> Callable[[], None]:
        """Return a function that performs an action, shows its error as a message, and draws."""

        def handle() -> None:
            self._preview.message = ""
            try:
                action()
            except PrtbakeError as error:
                self._preview.message = str(error)
            self.render()

        return handle

    def _add_lights(self, paths: Any) -> None:
        """Add the files that were dropped on the window as lights."""

        def add() -> None:
            for number in range(paths.GetNumberOfValues()):
                self._preview.add_light(paths.GetValue(number))

        self._handler(add)()

    def _slider(self, span: tuple[float, float], number: int, change: Callable[[float], None]) -> Any:
        def on_change(value: float) -> None:
            low, high = span
            if value != min(max(current(), low), high):  # the knob of an exposure beyond the slider is at its end
                change(value)
                self.render()

        def current() -> float:
            return self._preview.exposure if number else self._preview.rotation

        left, right = SLIDERS[number]
        slider = self.plotter.add_slider_widget(
            on_change,
            span,
            value=current(),
            pointa=(left, _SLIDER_HEIGHT),
            pointb=(right, _SLIDER_HEIGHT),
            color="white",
            interaction_event="always",
            slider_width=_KNOB[1],
            tube_width=_TUBE,
        )
        slider.GetRepresentation().GetTubeProperty().SetColor(_TUBE_GREY)  # also seen before an overexposed sky
        slider.GetRepresentation().SetSliderLength(_KNOB[0])
        slider.GetRepresentation().SetEndCapLength(0.0)
        slider.GetRepresentation().ShowSliderLabelOff()  # the text under it shows the value
        return slider

    def _update_texts(self) -> None:
        if self._saving:
            return
        preview, overlay = self._preview, self.overlay
        overlay.fit(self.plotter.window_size[0])
        reference = self._reference if self.view.showing_reference else None
        hint = "" if self._legend else "      h: keys"
        overlay.write(overlay.status, legend.status(preview, self._name, self.view.eye, reference) + hint)
        overlay.write(overlay.legend, legend.legend(preview, self._reference) if self._legend else "")
        covered = overlay.legend_bottom < _SLIDER_TOP  # in a small window
        self.exposure.SetEnabled(not covered)
        self.rotation.SetEnabled(preview.relightable and not covered)
        self.rotation.GetRepresentation().SetValue(preview.rotation)
        self.exposure.GetRepresentation().SetValue(preview.exposure)
        rotation = f"light {preview.rotation:+.0f}°" if preview.relightable else ""
        overlay.write(overlay.rotation, "" if covered else rotation)
        overlay.write(overlay.exposure, "" if covered else f"{preview.exposure:+.1f} EV")

    def _update_message(self) -> None:
        """Update the message and the scale, which are known only after drawing; draw again if they changed."""
        message, scale = self._preview.message, None if self.view.showing_reference else self._preview.scale
        message = legend.wrapped(message, self.plotter.window_size[0])
        if message != self.overlay.message.input or scale != self._scale:
            self._message_time = time.monotonic()
            self._scale = scale
            self.overlay.write(self.overlay.message, message)
            self.overlay.show_scale(scale)
            self.plotter.render()

    def _flip(self) -> None:
        self.view.toggle_reference()
        if self._reference is None:
            self._preview.message = "there is no reference picture: --compare gives one"

    def _toggle_legend(self) -> None:
        self._legend = not self._legend

    def _save_numbered(self) -> None:
        stem = Path(self._name).stem
        path = next(path for number in range(1, 10**6) if not (path := Path(f"{stem}_{number}.png")).exists())
        self.save(path)
        self._preview.message = f"saved as {path}"

    def _quit(self) -> None:
        self.plotter.iren.interactor.TerminateApp()
