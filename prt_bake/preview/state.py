"""The preview without its window: vertex colours for a mode, a light, its rotation and an eye."""

import dataclasses
import math
from collections.abc import Sequence
from enum import Enum
from threading import Thread
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError
from formats.image.png import to_linear
from prt_bake.geometry import camera
from prt_bake.lights import environment
from prt_bake.mathematics import sh
from prt_bake.preview import colours
from prt_bake.preview.lights import LightSource, ShownLight
from prt_bake.preview.mirrored import interface_of, prefiltered_sky
from prt_bake.preview.radiance import VertexRadiance
from prt_bake.preview.refinement import Refiner
from prt_bake.shading.asset_light import AssetLight
from prt_bake.shading.sun_shading import SunTreatment
from prt_bake.shading.tone_map import ToneMap

MOST_EXPOSURE = 64.0
"""EV, as far as `--exposure` goes."""
_SCALE_QUANTILE = 0.98
"""Quantile of the values at which the scale of false colours ends."""


class Mode(Enum):
    """The quantity that the object shows."""

    RADIANCE = "radiance"
    ERROR = "error"
    VALID = "valid vertices"
    COEFFICIENT = "coefficient"


class Scale(NamedTuple):
    """The scale of false colours: lowest and highest value, and the quantity."""

    low: float
    high: float
    label: str


class Preview:
    """An asset, its lights, and the options of the view.

    Attributes:
        asset: the asset; its `up` is the axis in use.
        lights: lights to switch between; may be empty for an asset made for one light.
        current: index of the light in use.
        rotation: of the light in degrees, counter-clockwise from above, within ±180.
        exposure: EV.
        tone_map: applied after the exposure, as by `prtbake shade --tone-map`.
        mode: the quantity shown.
        interface: the reflecting surface, or None if the index is 1, which reflects nothing.
        reflecting: whether the reflection is shown.
        background: whether the sky is shown behind the object.
        suns: the treatment of suns; "plain" while the requested one is switched off.
        harmonic: index l(l+1)+m of the coefficient shown.
        message: message to the user, or "".
        changes: counts all changes except those of the eye.
    """

    def __init__(
        self,
        asset: Asset,
        lights: Sequence[LightSource],
        *,
        up: str | None = None,
        rotation: float = 0.0,
        exposure: float = 0.0,
        suns: SunTreatment = "split",
        reflecting: bool = False,
        tone_map: ToneMap = "none",
    ) -> None:
        """Raises QueryError if no vertex was baked, or if there is no light for an asset that needs one."""
        if not asset.valid.any():
            raise QueryError(
                "asset: no vertex was baked, so there is nothing to show; bake it again (resume finishes a partial "
                "bake)"
            )
        self.asset = dataclasses.replace(asset, up=up or asset.up)
        self.lights = list(lights)
        if not self.lights and self.relightable:
            raise QueryError("light: expected at least one light, found none")
        self.current = 0
        self.rotation = self.exposure = 0.0
        self.mode = Mode.RADIANCE
        self.interface = interface_of(asset)
        self.reflecting, self.background, self.harmonic = reflecting, True, 0
        self.tone_map = tone_map
        self.message = ""
        self.changes = 0
        self.suns = suns
        self._treatment: SunTreatment = "split" if suns == "plain" else suns
        self._radiance = VertexRadiance(self.asset)
        self._refiner = Refiner(self.asset)
        self._loader: Thread | None = None
        low, high = self.asset.mesh.bounds
        margin = 1e-3 * self.asset.mesh.diagonal
        self._box = low - margin, high + margin
        self._colours = np.zeros((len(asset.valid), 4), np.float32)
        self._scale_end: float | None = None
        self._reflected_sky: tuple[ShownLight, NDArray[np.float32]] | None = None
        self._relight()
        self.rotate_to(rotation)
        self.set_exposure(exposure)

    @property
    def loading(self) -> bool:
        """Whether the compiled kernels are being loaded."""
        return self._loader is not None and self._loader.is_alive()

    @property
    def relightable(self) -> bool:
        """False for an asset made for one light, which cannot be relit or rotated."""
        return self.asset.quantity == "transfer"

    @property
    def light(self) -> ShownLight | None:
        """The light in use."""
        return self.lights[self.current].shown if self.lights else None

    @property
    def has_suns(self) -> bool:
        """Whether the light has suns that can be split off, or light for the asset's lobes."""
        if not self.relightable or self.light is None:
            return False
        prepared = self.light.prepared(self.asset, self._treatment)
        return prepared.found > 0 or prepared.lobes is not None

    def suns_shown(self, eye: ArrayLike) -> str | None:
        """Return the treatment of suns in the colours for this eye, or "lobes": "plain" until refined, None without
        suns.
        """
        if self.mode is not Mode.RADIANCE or not self.has_suns:
            return None
        if self._split_light.lobes is not None and not self._radiance.lacks_lobes:
            return "lobes"
        return "plain" if self.unrefined(eye) else self.suns

    @property
    def _split_light(self) -> AssetLight:
        """The light before its rotation, prepared for the asset."""
        if self.light is None or not self.relightable:
            return AssetLight(np.zeros((0, 3)))
        return self.light.prepared(self.asset, self.suns)

    @property
    def sky(self) -> NDArray[np.float32] | None:
        """The lat-long picture behind the object, or None."""
        if self.light is None or not self.background or self.mode is not Mode.RADIANCE:
            return None
        return self.light.picture

    @property
    def reflected_sky(self) -> NDArray[np.float32] | None:
        """The prefiltered lat-long picture that the surface reflects, or None."""
        light = self.light
        if self.interface is None or not self.reflecting or self.mode is not Mode.RADIANCE:
            return None
        if light is None or light.picture is None:
            return None
        if self._reflected_sky is None or self._reflected_sky[0] is not light:
            self._reflected_sky = light, prefiltered_sky(light.picture, self.interface.alpha)
        return self._reflected_sky[1]

    @property
    def to_sky(self) -> NDArray[np.float64]:
        """Matrix [3,3] from object space to the frame of the lat-long pictures, whose +z is row 0."""
        return environment.FROM_POLAR[self.asset.up].T @ environment.rotation(self.rotation, self.asset.up).T

    @property
    def scale(self) -> Scale | None:
        """The scale of the false colours drawn last, or None for radiance."""
        end = self._scale_end or 0.0
        if self.mode is Mode.ERROR:
            return Scale(0.0, end, "standard error")
        if self.mode is Mode.COEFFICIENT:
            l, m = self.degree_and_order
            return Scale(-end, end, f"a({l}, {m})")
        return None

    @property
    def degree_and_order(self) -> tuple[int, int]:
        """(l, m) of the coefficient shown."""
        l = math.isqrt(self.harmonic)
        return l, self.harmonic - l * (l + 1)

    @property
    def shown_exposure(self) -> float:
        """The exposure in EV; 0 for false colours."""
        return self.exposure if self.mode is Mode.RADIANCE else 0.0

    @property
    def shown_tone_map(self) -> ToneMap:
        """The tone map; "none" for false colours."""
        return self.tone_map if self.mode is Mode.RADIANCE else "none"

    def step_light(self, step: int = 1) -> None:
        """Switch to the next light, or by another number of steps."""
        self.current = (self.current + step) % len(self.lights)
        self._relight()

    def add_light(self, text: str) -> None:
        """Add a light, given as for `--light`, and switch to it; a known light is read again instead.

        Sets `message` if the asset was made for one light. Raises PrtbakeError if the light cannot be read.
        """
        if not self.relightable:
            self.message = "the asset was made for one light; it cannot show others"
            self.changes += 1
            return
        added = self.lights[self.current].sibling(text)
        texts = [source.text for source in self.lights]
        self.current = texts.index(text) if text in texts else len(texts)
        self.lights[self.current : self.current + 1] = [added]
        self._relight()

    def rotate_to(self, degrees: float) -> None:
        """Set the rotation of the light; it is reduced to ±180 degrees."""
        self.rotation = math.remainder(degrees, 360.0)
        self._relight()

    def set_exposure(self, exposure: float) -> None:
        """Set the exposure, clamped to ±64 EV."""
        self.exposure = min(max(exposure, -MOST_EXPOSURE), MOST_EXPOSURE)
        self.changes += 1

    def show(self, mode: Mode) -> None:
        """Show a quantity; a second call returns to radiance."""
        self.mode = Mode.RADIANCE if mode is self.mode else mode
        self._relight()

    def step_harmonic(self, step: int) -> None:
        """Show the next coefficient, or by another number of steps."""
        self.harmonic = (self.harmonic + step) % self._harmonics
        self.mode = Mode.COEFFICIENT
        self._relight()

    def toggle_reflection(self) -> None:
        """Toggle the surface reflection."""
        self.reflecting = not self.reflecting
        self.changes += 1

    def toggle_background(self) -> None:
        """Toggle the sky behind the object."""
        self.background = not self.background
        self.changes += 1

    def toggle_tone_map(self) -> None:
        """Toggle between AgX and none."""
        self.tone_map = "none" if self.tone_map == "agx" else "agx"
        self.changes += 1

    def toggle_suns(self) -> None:
        """Toggle between suns in the harmonics and the requested treatment."""
        self.suns = self._treatment if self.suns == "plain" else "plain"
        self._relight()

    def reload_lights(self) -> bool:
        """Reload lights whose files have changed; return whether any had, and set `message`."""
        messages = [message for source in self.lights if (message := source.reload()) is not None]
        if messages:
            self.message = messages[-1]
            self._relight()
        return bool(messages)

    def colours(self, eye: ArrayLike) -> NDArray[np.float32]:
        """Return weighted linear colours and weights [V,4] for an eye in object space.

        The weight is 1 for vertices with a value and 0 for others; the interpolated colour is the first three
        components divided by the fourth. Every call reuses the array.

        Raises QueryError for an eye that sees nothing, such as one inside the object.
        """
        buffer, valid = self._colours, self.asset.valid
        if self.mode is Mode.VALID:
            buffer[:, :3] = to_linear(np.where(valid[:, None], colours.VALID, colours.NOT_VALID))
            buffer[:, 3] = 1.0
            return buffer
        self._refuse_inside(np.asarray(eye, np.float64))
        buffer[:, 3] = valid
        if self.mode is Mode.RADIANCE:
            refined = self._refiner.radiance(eye)
            buffer[:, :3] = self._radiance.draw(eye) if refined is None else refined
            return buffer
        values = self._error(eye) if self.mode is Mode.ERROR else self._coefficient(eye)
        if self._scale_end is None:  # the scale stays while the eye moves
            self._scale_end = float(np.quantile(np.abs(values[valid]), _SCALE_QUANTILE)) or 1.0
        ramp = colours.from_zero if self.mode is Mode.ERROR else colours.about_zero
        buffer[:, :3] = to_linear(ramp(values / self._scale_end)) * valid[:, None]
        return buffer

    def refine(self, eye: ArrayLike, seconds: float = math.inf) -> bool:
        """Refine the suns for this eye for about `seconds`; return whether `colours` has just become refined.

        Does nothing without suns, while kernels are being loaded, and for an eye that sees nothing. Lobes need no more
        than loaded kernels.
        """
        if not self.unrefined(eye) or self.loading:
            return False
        if self._radiance.lacks_lobes:
            self.load()
            self.changes += 1
            return True
        try:
            radiance = self._refiner.refine(self._split_light, self.rotation, eye, self._radiance.draw, seconds)
        except QueryError:  # reported when it is drawn
            return False
        finished = radiance is not None
        self.changes += finished
        return finished

    @property
    def closed(self) -> bool:
        """Whether the mesh is closed: from outside, no face is seen from behind."""
        return self._refiner.closed

    def unrefined(self, eye: ArrayLike) -> bool:
        """Whether there are suns that are not yet refined for this eye, or lobes that are not yet drawn."""
        if self.mode is not Mode.RADIANCE:
            return False
        return self._radiance.lacks_lobes or (bool(self._split_light.suns) and self._refiner.radiance(eye) is None)

    def load(self) -> None:
        """Load the compiled kernels, which shade a frame ten times as fast."""
        if self._radiance.loaded:
            return  # two threads must not call numba kernels at once
        if self.relightable and self.asset.degree > 0:
            from prt_bake.shading.maximum_entropy import fit_maximum_entropy

            fit_maximum_entropy(np.ones((1, self._harmonics, 1)))
        # Last, because the drawing thread calls any kernel once these are loaded.
        self._radiance.load()

    def load_in_background(self) -> None:
        """Call `load` on a separate thread."""
        self._loader = Thread(target=self.load, daemon=True)
        self._loader.start()

    def _refuse_inside(self, eye: NDArray[np.float64]) -> None:
        low, high = self._box
        if ((eye >= low) & (eye <= high)).all():
            camera.refuse_eye_in_object(self.asset.mesh, eye)

    def _error(self, eye: ArrayLike) -> NDArray[np.float64]:
        """Return the standard error [V], rms over channels, relative to the object's rms radiance."""
        from prt_bake.shading.errors.radiance import radiance_error  # not needed by the first picture

        radiance = self._radiance.draw(eye).astype(np.float64)
        signal = math.sqrt(float((radiance[self.asset.valid] ** 2).mean()))
        light = None
        if self.light is not None and self.relightable:
            light = environment.rotate_light(self.light.harmonics, self.rotation, self.asset.up)
        outgoing = np.asarray(eye, np.float64) - self.asset.mesh.positions
        error = radiance_error(self.asset, light, outgoing)
        return np.asarray(np.sqrt((error**2).mean(axis=1)) / (signal or 1.0), np.float64)

    def _coefficient(self, eye: ArrayLike) -> NDArray[np.float64]:
        """Return the coefficient towards the eye [V], mean over channels."""
        # Drawn radiance is clamped at 0: the coefficient is that of a light of this harmonic less that of its negative.
        unit = np.zeros((self._harmonics, 3))
        unit[self.harmonic] = 1.0
        if not self.relightable:
            return np.asarray(self._radiance.draw(eye).mean(axis=1), np.float64)
        self._radiance.set_light(unit, 0.0)
        positive = self._radiance.draw(eye).mean(axis=1)  # a copy: the next call reuses the array
        self._radiance.set_light(-unit, 0.0)
        return np.asarray(positive - self._radiance.draw(eye).mean(axis=1), np.float64)

    @property
    def _harmonics(self) -> int:
        return sh.count(self.asset.degree) if self.relightable else 1

    def _relight(self) -> None:
        if self.relightable and self.light is not None:
            light, damped = self._split_light, self.suns == "window"
            harmonics = light.harmonics if damped else self.light.harmonics
            self._radiance.set_light(harmonics if light.lobes is None else light, self.rotation)
        self._scale_end = None
        self._refiner.reset()
        self.changes += 1
