"""The window: keys, sliders, and a timer that looks for skies that have changed."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from formats.errors import PrtbakeError
from formats.interrupts import interrupt_flag
from prt_bake.preview import legend
from prt_bake.preview.canvas import Canvas
from prt_bake.preview.overlay import SLIDERS, Overlay
from prt_bake.preview.state import MOST_EXPOSURE, Mode, Preview
from prt_bake.preview.view import View, write_picture

__all__ = ["Canvas", "View", "Window", "write_picture"]

TICK = 100
"""Milliseconds between two looks at the files."""
_TURN, _EXPOSE = 5.0, 0.5
_MESSAGE_SECONDS = 6.0
"""Seconds that a message stays."""
_STILL = 0.2
"""Seconds after the last movement until edges are drawn smooth again, and suns are met apart."""
_SLICE, _PAUSE = 0.02, 1
"""Seconds that this goes on between two looks at the user's deeds, and milliseconds until it goes on."""


class Window:
    """A view with all that one drives it by; `run` hands it to the user.

    Attributes:
        view: what is drawn.
        overlay: what is written over it.
        rotation, exposure: the sliders; rotation is None for an asset made for one light.
    """

    def __init__(self, view: View, name: str, reference: str | None = None) -> None:
        """name: of the asset. reference: the name of the picture to compare with."""
        self.view, self._name, self._reference = view, name, reference
        self._preview: Preview = view.preview
        self.overlay = Overlay(view.canvas.renderer, view.window.GetSize()[0])
        self._legend = self._bare = self._loading = False
        self._moved = self._said = -math.inf
        self._interrupted: Callable[[], bool] = lambda: False
        self._interactor: Any = view.canvas.interactor
        self._drive()
        self.rotation = self._slider((-180.0, 180.0), 0, self._preview.rotate_to)
        self.exposure = self._slider((-MOST_EXPOSURE, MOST_EXPOSURE), 1, self._preview.expose)
        if not self._preview.relightable:
            self.rotation.Off()
        self.overlay.write(self.overlay.message, "")
        self._tell()

    def run(self) -> None:
        """Show it until the user closes it, by Ctrl-C too."""
        # An interrupt that is raised among VTK's events ends the process there, with words of VTK's.
        with interrupt_flag() as self._interrupted:
            self._interactor.Initialize()
            self.render()
            self._preview.load_in_background()
            self._interactor.CreateRepeatingTimer(TICK)
            self._interactor.Start()

    def render(self) -> None:
        """Draw, with words and sliders brought up to date."""
        self.view.window.Render()
        self._tell_after()

    def tick(self) -> None:
        """What the timer does: closes after Ctrl-C, reads skies that have changed, takes off old messages, smooths what
        stands still and meets its suns apart.
        """
        if self._interrupted():
            self._quit()
            return
        now = time.monotonic()
        changed = self._preview.reload_lights()
        if not changed and self._preview.message and now - self._said > _MESSAGE_SECONDS:
            self._preview.message = ""
            changed = True
        if self._loading is not self._preview.loading:
            self._loading = self._preview.loading
            changed = True
        still = now - max(self._moved, self.view.changed) > _STILL
        if not self.view.smooth_edges and still:
            self.view.smooth(True)
            changed = True
        if still and self.view.unrefined:
            changed |= self.view.refine(_SLICE)
            self._interactor.CreateOneShotTimer(_PAUSE)
        if changed:
            self.render()

    def save(self, path: Path) -> None:
        """Write the picture alone, without words and sliders, as PNG."""
        shown, sliders = self.overlay.hide(), [each for each in (self.rotation, self.exposure) if each.GetEnabled()]
        for slider in sliders:
            slider.Off()
        self.view.smooth(True)
        self.view.refine()
        self._bare = True
        try:
            write_picture(path, self.view.picture())
        finally:
            self._bare = False
            self.overlay.restore(shown)
            for slider in sliders:
                slider.On()

    def _drive(self) -> None:
        canvas = self.view.canvas
        canvas.connect_mouse(self._move)
        canvas.connect_keys({name: self._doing(action) for names, action in self._actions() for name in names.split()})
        canvas.connect_drops(self._take)
        self._interactor.AddObserver("TimerEvent", lambda *_: self.tick())
        self.view.window.AddObserver("StartEvent", lambda *_: self._tell())

    def _actions(self) -> list[tuple[str, Callable[[], None]]]:
        preview = self._preview
        actions: list[tuple[str, Callable[[], None]]] = [
            ("h question", self._flip_legend),
            ("0 Home", self.view.reset_camera),
            ("Up", lambda: preview.set_exposure(preview.exposure + _EXPOSE)),
            ("Down", lambda: preview.set_exposure(preview.exposure - _EXPOSE)),
            ("r", preview.toggle_reflection),
            ("b", preview.toggle_background),
            ("u", preview.toggle_suns),
            ("e", lambda: preview.show(Mode.ERROR)),
            ("v", lambda: preview.show(Mode.VALID)),
            ("c", lambda: preview.show(Mode.COEFFICIENT)),
            ("period greater", lambda: preview.step_harmonic(1)),
            ("comma less", lambda: preview.step_harmonic(-1)),
            ("space", self.view.flip),
            ("s", self._save_anew),
            ("q Escape", self._quit),
        ]
        if preview.relightable:
            actions.append(("Left", lambda: preview.rotate_to(preview.rotation - _TURN)))
            actions.append(("Right", lambda: preview.rotate_to(preview.rotation + _TURN)))
        if preview.lights:
            actions.append(("n", preview.step_light))
            actions.append(("N", lambda: preview.step_light(-1)))
        return actions

    def _doing(self, action: Callable[[], None]) -> Callable[[], None]:
        def do() -> None:
            self._preview.message = ""
            try:
                action()
            except PrtbakeError as fault:  # a window that is open has better things to do than to end
                self._preview.message = str(fault)
            self.render()

        return do

    def _take(self, paths: list[str]) -> None:
        """Show the lights that were dropped on the window."""

        def add() -> None:
            for path in paths:
                self._preview.add_light(path)

        self._doing(add)()

    def _move(self) -> None:
        """Draw fast while something moves."""
        self._moved = time.monotonic()
        if self.view.smooth_edges:
            self.view.smooth(False)

    def _slider(self, span: tuple[float, float], place: int, change: Callable[[float], None]) -> Any:
        def slide(value: float) -> None:
            if value != wanted():
                self._move()
                change(value)
                self.render()

        def wanted() -> float:
            return self._preview.exposure if place else self._preview.rotation

        return self.view.canvas.slider(span, wanted(), SLIDERS[place], slide)

    def _tell(self) -> None:
        if self._bare:
            return
        preview, overlay = self._preview, self.overlay
        reference = self._reference if self.view.showing_reference else None
        hint = "" if self._legend else "      h: keys"
        overlay.write(overlay.status, legend.status(preview, self._name, self.view.eye, reference) + hint)
        overlay.write(overlay.legend, legend.legend(preview, self._reference) if self._legend else "")
        self.rotation.GetRepresentation().SetValue(preview.rotation)
        self.exposure.GetRepresentation().SetValue(preview.exposure)
        overlay.write(overlay.rotation, f"light {preview.rotation:+.0f}°" if preview.relightable else "")
        overlay.write(overlay.exposure, f"{preview.exposure:+.1f} EV")

    def _tell_after(self) -> None:
        """What is known only once it is drawn; drawn again where it is news."""
        message, scale = self._preview.message, None if self.view.showing_reference else self._preview.scale
        message = legend.wrapped(message, self.view.window.GetSize()[0])
        if message != self.overlay.message.GetInput() or scale != self._scale:
            self._said = time.monotonic()
            self._scale = scale
            self.overlay.write(self.overlay.message, message)
            self.overlay.show_scale(scale)
            self.view.window.Render()

    _scale: Any = None

    def _flip_legend(self) -> None:
        self._legend = not self._legend

    def _save_anew(self) -> None:
        numbers = iter(range(1, 10**6))
        stem = Path(self._name).stem
        path = next(path for number in numbers if not (path := Path(f"{stem}_{number}.png")).exists())
        self.save(path)
        self._preview.message = f"saved as {path}"

    def _quit(self) -> None:
        self._interactor.TerminateApp()
