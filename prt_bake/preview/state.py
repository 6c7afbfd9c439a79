"""What a preview shows, without a window: colours at the vertices for a mode, a light, its rotation and an eye."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from threading import Thread
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.geometry import camera
from prt_bake.lights import environment
from prt_bake.mathematics import sh
from prt_bake.preview import colours
from prt_bake.preview.lights import LightSource, ShownLight
from prt_bake.preview.mirrored import prefiltered_sky
from prt_bake.preview.radiance import VertexRadiance
from prt_bake.preview.refinement import Refiner
from prt_bake.shading.suns import SunsApart, SunTreatment

MOST_EXPOSURE = 10.0
_SAME_INDEX = 1e-9
_MOST_OF_SCALE = 0.98
"""Quantile of what is shown in false colours that their scale ends at."""


class Mode(Enum):
    """What is shown of the object."""

    RADIANCE = "radiance"
    ERROR = "error"
    VALID = "valid vertices"
    COEFFICIENT = "coefficient"


class Scale(NamedTuple):
    """What false colours mean: the values of the first and of the last, and of what."""

    low: float
    high: float
    words: str


@dataclass(frozen=True, eq=False)
class Interface:
    """The surface's reflection: relative index `eta`, roughness `alpha`."""

    eta: float
    alpha: float


class Preview:
    """An asset, the lights it may be seen under, and what is chosen to be shown.

    Attributes:
        asset: up is the axis in use.
        lights: those to go through; may be empty for an asset made for one light.
        which: the one that shines.
        rotation: of the light, degrees, counter-clockwise seen from above, within ±180.
        exposure: EV.
        mode: what is shown of the object.
        interface: what the surface reflects by, None where the index is 1: there is nothing to reflect.
        reflecting: whether that is shown.
        background: whether the sky is shown behind the object.
        suns: how they are met: the treatment asked for, or "plain" while that is switched off.
        harmonic: index l(l+1)+m of the coefficient that is shown.
        message: what there is to say, "" where nothing is.
        changes: rises with every change but those of the eye.
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
    ) -> None:
        """Raises QueryError where there is nothing to show: no vertex was baked, or no light is there to relight by."""
        if not asset.valid.any():
            raise QueryError("asset: no vertex was baked, there is nothing to show; finish the bake with --resume")
        self.asset = dataclasses.replace(asset, up=up or asset.up)
        self.lights = list(lights)
        if not self.lights and self.relightable:
            raise QueryError("light: there is none; give at least one")
        self.current = 0
        self.rotation = self.exposure = 0.0
        self.mode = Mode.RADIANCE
        self.interface = _interface(asset)
        self.reflecting, self.background, self.harmonic = False, True, 0
        self.message = ""
        self.changes = 0
        self.suns = suns
        self._treatment: SunTreatment = "split" if suns == "plain" else suns
        self._radiance = VertexRadiance(self.asset)
        self._refiner = Refiner(self.asset)
        self._loader: Thread | None = None
        low, high = self.asset.mesh.bounds
        reach = 1e-3 * self.asset.mesh.diagonal
        self._box = low - reach, high + reach
        self._shown = np.zeros((len(asset.valid), 4), np.float32)
        self._top: float | None = None
        self._reflected_sky: tuple[ShownLight, NDArray[np.float32]] | None = None
        self._relight()
        self.rotate_to(rotation)
        self.set_exposure(exposure)

    @property
    def loading(self) -> bool:
        """Whether kernels are being loaded meanwhile."""
        return self._loader is not None and self._loader.is_alive()

    @property
    def relightable(self) -> bool:
        """False for an asset made for one light: no other light and no rotation is of any meaning to it."""
        return self.asset.quantity == "transfer"

    @property
    def light(self) -> ShownLight | None:
        """The light that shines."""
        return self.lights[self.current].shown if self.lights else None

    @property
    def has_suns(self) -> bool:
        """Whether there are suns in the light, small and strong enough to be met apart."""
        return self.relightable and self.light is not None and self.light.apart(self._treatment).found > 0

    def suns_shown(self, eye: ArrayLike) -> SunTreatment | None:
        """How suns are met in the colours for this eye, None where there are none; "plain" until they are settled."""
        if self.mode is not Mode.RADIANCE or not self.has_suns:
            return None
        return "plain" if self.unrefined(eye) else self.suns

    @property
    def _lit(self) -> SunsApart:
        """The light before it is turned, divided as is asked for."""
        if self.light is None or not self.relightable:
            none = np.zeros((0, 3))
            return SunsApart(none, (), none, 0)
        return self.light.apart(self.suns)

    @property
    def sky(self) -> NDArray[np.float32] | None:
        """The lat-long picture behind the object, None where there is none to be shown."""
        if self.light is None or not self.background or self.mode is not Mode.RADIANCE:
            return None
        return self.light.picture

    @property
    def reflected_sky(self) -> NDArray[np.float32] | None:
        """The lat-long picture that the surface mirrors, None where it mirrors nothing now."""
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
        """Of the false colours that were drawn last, None where colours are light."""
        if self.mode is Mode.ERROR:
            return Scale(0.0, self._top or 0.0, "standard error, share of the object's radiance")
        if self.mode is Mode.COEFFICIENT:
            top = self._top or 0.0
            l, m = self.degree_and_order
            return Scale(-top, top, f"a({l}, {m})")
        return None

    @property
    def degree_and_order(self) -> tuple[int, int]:
        """(l, m) of the coefficient that is shown."""
        l = math.isqrt(self.harmonic)
        return l, self.harmonic - l * (l + 1)

    @property
    def shown_exposure(self) -> float:
        """EV to show the colours with: false ones are shown as they are."""
        return self.exposure if self.mode is Mode.RADIANCE else 0.0

    def step_light(self, step: int = 1) -> None:
        """The next light, or the one before."""
        self.current = (self.current + step) % len(self.lights)
        self._relight()

    def add_light(self, text: str) -> None:
        """Show a further light, named as the command line names it; one that is there already is read again. Raises
        PrtbakeError where it cannot be read; says why where the asset takes no other light.
        """
        if not self.relightable:
            self.message = "made for one light: no other can be shown"
            self.changes += 1
            return
        added = self.lights[self.current].sibling(text)
        texts = [source.text for source in self.lights]
        self.current = texts.index(text) if text in texts else len(texts)
        self.lights[self.current : self.current + 1] = [added]
        self._relight()

    def rotate_to(self, degrees: float) -> None:
        """Turn the light to a rotation; whole turns are taken off."""
        self.rotation = math.remainder(degrees, 360.0)
        self._relight()

    def set_exposure(self, exposure: float) -> None:
        """Set the exposure, as far as it goes."""
        self.exposure = min(max(exposure, -MOST_EXPOSURE), MOST_EXPOSURE)
        self.changes += 1

    def show(self, mode: Mode) -> None:
        """Show this of the object; radiance again where it is shown already."""
        self.mode = Mode.RADIANCE if mode is self.mode else mode
        self._relight()

    def step_harmonic(self, step: int) -> None:
        """Show the next coefficient, or the one before."""
        self.harmonic = (self.harmonic + step) % self._harmonics
        self.mode = Mode.COEFFICIENT
        self._relight()

    def toggle_reflection(self) -> None:
        """With the surface's reflection, or without; says why where there is none."""
        if self.interface is None:
            self.message = "no reflection: the object's index of refraction is 1"
        else:
            self.reflecting = not self.reflecting
        self.changes += 1

    def toggle_background(self) -> None:
        """With the sky behind the object, or without."""
        self.background = not self.background
        self.changes += 1

    def toggle_suns(self) -> None:
        """Suns as harmonics like all other light, or met as was asked for; says why where there is none."""
        if not self.has_suns:
            self.message = "no suns: nothing in this light is small and strong"
        self.suns = self._treatment if self.suns == "plain" else "plain"
        self._relight()

    def reload_lights(self) -> bool:
        """Read again what has changed on disk; whether anything had, which `message` then tells."""
        said = [words for source in self.lights if (words := source.reload()) is not None]
        if said:
            self.message = said[-1]
            self._relight()
        return bool(said)

    def colours(self, eye: ArrayLike) -> NDArray[np.float32]:
        """Linear colours times a share, and the share, [V,4], for an eye in object space; a buffer that the next call
        writes over. The share is 1 where a vertex has something to show, else 0: between vertices the colour is the
        first three over the last.

        Raises QueryError for an eye from which nothing can be shown, such as one inside the object.
        """
        shown, valid = self._shown, self.asset.valid
        if self.mode is Mode.VALID:
            shown[:, :3] = colours.as_light(np.where(valid[:, None], colours.VALID, colours.NOT_VALID))
            shown[:, 3] = 1.0
            return shown
        self._refuse_inside(np.asarray(eye, np.float64))
        shown[:, 3] = valid
        if self.mode is Mode.RADIANCE:
            settled = self._refiner.radiance(eye)
            shown[:, :3] = self._radiance.draw(eye) if settled is None else settled
            return shown
        values = self._error(eye) if self.mode is Mode.ERROR else self._coefficient(eye)
        if self._top is None:  # a scale that stays while the eye moves
            self._top = float(np.quantile(np.abs(values[valid]), _MOST_OF_SCALE)) or 1.0
        ramp = colours.from_zero if self.mode is Mode.ERROR else colours.about_zero
        shown[:, :3] = colours.as_light(ramp(values / self._top)) * valid[:, None]
        return shown

    def refine(self, eye: ArrayLike, seconds: float = math.inf) -> bool:
        """Meet suns apart as this eye sees them, for about so long; whether `colours` gives them from now on.

        Nothing is done where there are none, while kernels are loaded meanwhile, and for an eye that sees nothing.
        """
        if not self.unrefined(eye) or self.loading:
            return False
        try:
            ready = self._refiner.refine(self._lit, self.rotation, eye, self._radiance.draw, seconds) is not None
        except QueryError:  # told when it is drawn
            return False
        self.changes += ready
        return ready

    @property
    def closed(self) -> bool:
        """Whether no face of the object is seen from behind but from inside."""
        return self._refiner.closed

    def unrefined(self, eye: ArrayLike) -> bool:
        """Whether there are suns to be met apart that `colours` does not give yet."""
        return self.mode is Mode.RADIANCE and bool(self._lit.suns) and self._refiner.radiance(eye) is None

    def load(self) -> None:
        """Load the compiled kernels: from then on a frame takes a tenth of the time."""
        if self._radiance.loaded:
            return  # kernels of numba's must not be called by two threads at once
        if self.relightable and self.asset.degree > 0:
            from prt_bake.shading.maximum_entropy import positive_transport

            positive_transport(np.ones((1, self._harmonics, 1)))
        # Last: who finds them loaded may call any of them.
        self._radiance.load()

    def load_in_background(self) -> None:
        """`load` on a thread of its own."""
        self._loader = Thread(target=self.load, daemon=True)
        self._loader.start()

    def _refuse_inside(self, eye: NDArray[np.float64]) -> None:
        low, high = self._box
        if ((eye >= low) & (eye <= high)).all():
            camera.refuse_eye_in_object(self.asset.mesh, eye)

    def _error(self, eye: ArrayLike) -> NDArray[np.float64]:
        """One sigma, rms over channels, over the rms radiance of all vertices [V], see `radiance_error`."""
        from prt_bake.shading.radiance_error import radiance_error  # what a first picture can do without

        radiance = self._radiance.draw(eye).astype(np.float64)
        signal = math.sqrt(float((radiance[self.asset.valid] ** 2).mean()))
        light = None
        if self.light is not None and self.relightable:
            light = environment.rotate_light(self.light.harmonics, self.rotation)
        towards = np.asarray(eye, np.float64) - self.asset.mesh.positions
        error = radiance_error(self.asset, light, towards)
        return np.asarray(np.sqrt((error**2).mean(axis=1)) / (signal or 1.0), np.float64)

    def _coefficient(self, eye: ArrayLike) -> NDArray[np.float64]:
        """Its mean over channels [V], as seen from the eye."""
        # What is drawn has no sign: the coefficient is what a light of this harmonic alone gives, less its opposite.
        one = np.zeros((self._harmonics, 3))
        one[self.harmonic] = 1.0
        if not self.relightable:
            return np.asarray(self._radiance.draw(eye).mean(axis=1), np.float64)
        self._radiance.set_light(one, 0.0)
        above = self._radiance.draw(eye).mean(axis=1)  # another array than the one that is drawn on
        self._radiance.set_light(-one, 0.0)
        return np.asarray(above - self._radiance.draw(eye).mean(axis=1), np.float64)

    @property
    def _harmonics(self) -> int:
        return sh.count(self.asset.degree) if self.relightable else 1

    def _relight(self) -> None:
        if self.relightable and self.light is not None:
            damped = self.suns == "window"
            self._radiance.set_light(self._lit.harmonics if damped else self.light.harmonics, self.rotation)
        self._changed()

    def _changed(self) -> None:
        self._top = None
        self._refiner.forget()
        self.changes += 1


def _interface(asset: Asset) -> Interface | None:
    if abs(asset.eta - 1.0) < _SAME_INDEX:
        return None
    return Interface(asset.eta, asset.roughness or 0.0)
