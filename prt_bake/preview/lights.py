"""The lights of a preview, which are reloaded when their files change."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.errors import PrtbakeError
from formats.mesh import Mesh
from formats.scene.lights import WORDS, SkyLight, read_lights
from prt_bake.lights import environment
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, read_lighting
from prt_bake.preview.mirrored import resampled_sky
from prt_bake.shading.asset_light import AssetLight, prepare_light
from prt_bake.shading.sun_shading import SunTreatment

_MOST_ROWS = 2048
_ROWS_OF_DISCS = 512
"""Fewest rows of a background picture that combines several lights."""

Stamp = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, eq=False)
class ShownLight:
    """A light, its SH coefficients [K,3], and a lat-long picture of its skies and discs, or None without them."""

    lighting: Lighting
    harmonics: NDArray[np.float64]
    picture: NDArray[np.float32] | None
    _prepared: dict[SunTreatment, AssetLight] = field(default_factory=dict, init=False, repr=False)

    def prepared(self, asset: Asset, treatment: SunTreatment) -> AssetLight:
        """Return the light prepared for the preview's asset; computed on first use."""
        if treatment not in self._prepared:
            self._prepared[treatment] = prepare_light(asset, self.lighting, treatment)
        return self._prepared[treatment]


class LightSource:
    """A light of the preview: a sky, a lights file, a sun or a sphere light, or several together.

    Attributes:
        text: the light as `--light` takes it, or "" for several and for a lighting.
        name: the name in the window.
        shown: the light as last read; stays if its file cannot be read any more.
    """

    def __init__(
        self,
        light: str | Sequence[str] | Lighting,
        up: str,
        degree: int,
        mend: bool = False,
        say: Callable[[str], None] = warnings.warn,
        mesh: Mesh | None = None,
    ) -> None:
        """Read the light, unless it is a lighting; arguments and errors are those of `read_lighting`."""
        self.text = light if isinstance(light, str) else ""
        self._lighting = light if isinstance(light, Lighting) else None
        self._texts = [light] if isinstance(light, str) else [] if isinstance(light, Lighting) else list(light)
        self._up, self._degree = up, degree
        self._mend, self._say, self._mesh = mend, say, mesh
        self.name = " + ".join(text if text.startswith(tuple(WORDS)) else Path(text).name for text in self._texts)
        self._stamp = self._stamps()
        self.shown = self._read()

    def sibling(self, text: str) -> "LightSource":
        """Return another light, read with the same options."""
        return LightSource(text, self._up, self._degree, self._mend, self._say, self._mesh)

    def reload(self) -> str | None:
        """Read the light again if one of its files has changed; return a message, or None if nothing changed."""
        stamp = self._stamps()
        if stamp == self._stamp:
            return None
        # Stored before reading: a file that is written meanwhile is read again at the next call.
        self._stamp = stamp
        try:
            self.shown = self._read()
        except PrtbakeError as error:
            return f"{error} (still showing the earlier {self.name})"
        return f"{self.name} was reloaded"

    def _read(self) -> ShownLight:
        lighting = self._lighting
        if lighting is None:
            lighting = read_lighting(self._texts, self._up, mend=self._mend, say=self._say, mesh=self._mesh)
        return ShownLight(lighting, project_lighting(lighting, self._degree), _picture(lighting, self._up))

    def _stamps(self) -> Stamp:
        return tuple(_stamp(path) for path in self._files())

    def _files(self) -> Iterator[Path]:
        for text in self._texts:
            if text.startswith(tuple(WORDS)):
                continue
            yield Path(text)
            if text.lower().endswith(".toml"):
                try:
                    lights = read_lights(text)
                except PrtbakeError:
                    continue  # reported when it is read
                yield from (light.path for light in lights if isinstance(light, SkyLight))


def _stamp(path: Path) -> tuple[str, int, int]:
    try:
        status = path.stat()
    except OSError:
        return str(path), 0, -1
    return str(path), status.st_mtime_ns, status.st_size


def _picture(lighting: Lighting, up: str) -> NDArray[np.float32] | None:
    skies = lighting.skies
    discs = any(sun.angular_diameter > 0.0 for sun in lighting.suns)
    if not skies and not discs:
        return None
    if len(skies) == 1 and not discs and np.array_equal(skies[0].turn, np.eye(3)):
        image = skies[0].image
        return image if len(image) <= _MOST_ROWS else resampled_sky(image, _MOST_ROWS).astype(np.float32)
    rows = min(max([_ROWS_OF_DISCS, *(len(sky.image) for sky in skies)]), _MOST_ROWS)
    u, v = (np.arange(2 * rows) + 0.5) / (2 * rows), (np.arange(rows) + 0.5) / rows
    picture = np.empty((rows, 2 * rows, 3), np.float32)
    for row in range(rows):
        picture[row] = lighting.radiance(environment.direction_of(u, v[row], up))
    return picture
