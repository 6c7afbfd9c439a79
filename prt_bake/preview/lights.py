"""The lights of a preview: each is read from what the command line names, and again when its file has changed."""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.errors import PrtbakeError
from formats.mesh import Mesh
from formats.scene.lights import SkyLight, read_lights
from prt_bake.lights import environment
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, read_lighting
from prt_bake.mathematics import sh
from prt_bake.preview.mirrored import resampled_sky
from prt_bake.shading.suns import SunsApart, SunTreatment, suns_apart

_MOST_ROWS = 2048
_ROWS_OF_DISCS = 512
"""Rows of the picture behind the object where it is made of several lights."""
_NOT_FILES = ("sun:", "sphere:")

Stamp = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, eq=False)
class ShownLight:
    """A light, its coefficients [K,3], and a lat-long picture of all of it that has a size; None where nothing has."""

    lighting: Lighting
    harmonics: NDArray[np.float64]
    picture: NDArray[np.float32] | None
    _apart: dict[SunTreatment, SunsApart] = field(default_factory=dict, init=False, repr=False)

    def apart(self, treatment: SunTreatment) -> SunsApart:
        """Its suns and the rest, found when first asked for."""
        if treatment not in self._apart:
            self._apart[treatment] = suns_apart(self.lighting, sh.degree_of(len(self.harmonics)), treatment)
        return self._apart[treatment]


class LightSource:
    """A sky, a lights file, a sun or a sphere light, as the command line names it: one light of a preview.

    Attributes:
        text: how the command line names it.
        name: what it is called in the window.
        shown: as it was read last; a file that cannot be read leaves it as it was.
    """

    def __init__(
        self,
        text: str,
        up: str,
        degree: int,
        mend: bool = False,
        say: Callable[[str], None] = warnings.warn,
        mesh: Mesh | None = None,
    ) -> None:
        """Read it; `mend`, `say`, `mesh` and what is raised are those of `prt_bake.lights.lighting.read_lighting`."""
        self.text, self._up, self._degree = text, up, degree
        self._mend, self._say, self._mesh = mend, say, mesh
        self.name = text if text.startswith(_NOT_FILES) else Path(text).name
        self._stamp = self._stamps()
        self.shown = self._read()

    def sibling(self, text: str) -> "LightSource":
        """Another light, read as this one is."""
        return LightSource(text, self._up, self._degree, self._mend, self._say, self._mesh)

    def reload(self) -> str | None:
        """Read it again if a file of it has changed; what to say about it, or None where nothing has changed."""
        stamp = self._stamps()
        if stamp == self._stamp:
            return None
        # Noted before reading: a file that is written meanwhile is read once more.
        self._stamp = stamp
        try:
            self.shown = self._read()
        except PrtbakeError as fault:
            return f"{fault} (still showing what {self.name} was before)"
        return f"{self.name} has changed and was read again"

    def _read(self) -> ShownLight:
        lighting = read_lighting([self.text], self._up, mend=self._mend, say=self._say, mesh=self._mesh)
        return ShownLight(lighting, project_lighting(lighting, self._degree), _picture(lighting, self._up))

    def _stamps(self) -> Stamp:
        return tuple(_stamp(path) for path in self._files())

    def _files(self) -> Iterator[Path]:
        if self.text.startswith(_NOT_FILES):
            return
        yield Path(self.text)
        if self.text.lower().endswith(".toml"):
            try:
                lights = read_lights(self.text)
            except PrtbakeError:
                return  # told when it is read
            yield from (one.path for one in lights if isinstance(one, SkyLight))


def _stamp(path: Path) -> tuple[str, int, int]:
    try:
        found = path.stat()
    except OSError:
        return str(path), 0, -1
    return str(path), found.st_mtime_ns, found.st_size


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
