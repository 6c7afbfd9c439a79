"""Which channels of an OpenEXR file are its colour.

Layers are channel names up to the last dot (https://openexr.com/en/latest/TechnicalIntroduction.html#layers), or parts.
R, G and B without a layer come first, then a layer or part named beauty, Combined, rgba or the like, as Blender,
Arnold, Houdini, Redshift and Unreal name it. Else the only layer of colour is read; of several none is better than the
others. Layers named after positions, normals, depths, motion or objects are data, even if they have R, G and B.
"""

import os
import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from formats.errors import ImageError, warn
from formats.image import gamut
from formats.image.exr_header import Part, primaries_of, read_parts, refuse_windows
from formats.text import printable

_LETTERS = (("R", "G", "B"), ("r", "g", "b"), ("red", "green", "blue"))
_BEAUTY = {"beauty", "combined", "rgba", "rgb", "color", "colour", "c", "ci", "main", "final", "finalimage"}
_DATA = re.compile(
    r"[np](world|cam(era)?|obj(ect)?)?|ng|ns|pref|z|st|stmap|uvs?|vectors?|motion|mist|id|indexob|indexma|coverage"
    r"|.*crypto.*|.*(normals?|positions?|depth|velocity|motionvec(tor)?s?|displacement|multimatte)"
    r"|.*(object|material|render|node|instance|prim)id"
)
"""Names of layers that hold no colour, in lower case and letters only."""
_NOT_LUMINANCE = {"X", "U", "V", "RY", "BY"}
"""Channels that make the Y beside them a coordinate, or the luminance of an encoding with chroma."""
_DEFAULT, _NAMED, _WITHOUT_LAYER, _OTHER = 3, 2, 1, 0
_MOST_LISTED = 12


@dataclass(frozen=True, eq=False)
class ExrColour:
    """The channels that are the colour of a file.

    Attributes:
        path: the file.
        part: their part.
        names: the channels for red, green and blue; three times the same for luminance.
        label: what the layer is called in messages.
        others: labels of the other layers of colour.
    """

    path: str | os.PathLike[str]
    part: Part
    names: tuple[str, str, str]
    label: str
    others: tuple[str, ...]

    @property
    def subsampled(self) -> bool:
        """Whether any channel of the part stores fewer pixels than there are."""
        return any(distances != (1, 1) for distances in self.part.sampling.values())

    @property
    def alpha(self) -> str:
        """The name of the channel that is the alpha of the colour, if the part has it."""
        layer, _, letter = self.names[0].rpartition(".")
        return _joined(layer, {"r": "a", "red": "alpha"}.get(letter, "A"))

    @property
    def primaries(self) -> gamut.Primaries | None:
        """What the file says about the primaries; None for luminance."""
        return None if self.names[0] == self.names[1] else primaries_of(self.part)


@dataclass(frozen=True)
class _Candidate:
    part: Part
    names: tuple[str, str, str]
    label: str
    rank: tuple[int, bool]


def open_colour(path: str | os.PathLike[str], data: bool = False) -> ExrColour:
    """Read the headers and choose the colour; a warning names a layer that was chosen by its name.

    As `data`, the only channel of a file is read whatever its name, such as A.

    Raises:
        ImageError: the file is not OpenEXR or damaged; it has no colour, or several layers that are equally good.
    """
    parts = read_parts(path)
    candidates = [found for part in parts for found in _candidates(part, several=len(parts) > 1)]
    if data and not candidates:
        candidates = _only_channel(parts)
    if not candidates:
        raise _no_colour(path, parts)
    highest = max(candidate.rank for candidate in candidates)
    best = [candidate for candidate in candidates if candidate.rank == highest]
    if len(best) > 1:
        raise ImageError(
            f"{path}: has several layers of colour: {_listed(candidate.label for candidate in best)}; expected one "
            "that is named beauty, Combined or rgba, or channels R, G and B: save the picture that is meant alone"
        )
    chosen = best[0]
    others = tuple(candidate.label for candidate in candidates if candidate is not chosen)
    if others and highest[0] < _DEFAULT:
        warn(f"{path}: the colours are those of {chosen.label}; the file also has {_listed(others)}")
    refuse_windows(path, chosen.part)
    return ExrColour(path, chosen.part, chosen.names, chosen.label, others)


def _candidates(part: Part, several: bool) -> Iterator[_Candidate]:
    """Yield the layers of colour of a part; `several`: the file has other parts."""
    for layer in sorted({name.rpartition(".")[0] for name in part.sampling}):
        rgb = _rgb(layer, part.sampling)
        names = rgb or _luminance(layer, part.sampling)
        title = layer or (part.name if several else "")
        word = re.sub(r"[^a-z]", "", title.rpartition(".")[2].lower())
        if names is None or part.deep or _DATA.fullmatch(word):
            continue
        level = _NAMED if word in _BEAUTY else _OTHER if layer else _WITHOUT_LAYER if several else _DEFAULT
        yield _Candidate(part, names, _label(part, layer, names, several), (level, rgb is not None))


def _only_channel(parts: list[Part]) -> list[_Candidate]:
    """The only channel of the only part; an empty list if there are more, or if it is a depth."""
    if len(parts) > 1 or parts[0].deep or len(parts[0].sampling) != 1:
        return []
    (name,) = parts[0].sampling
    if name.rpartition(".")[2] == "Z":
        return []
    return [_Candidate(parts[0], (name, name, name), f"the channel {printable(name)}", (_DEFAULT, False))]


def _rgb(layer: str, channels: Collection[str]) -> tuple[str, str, str] | None:
    for letters in _LETTERS:
        red, green, blue = (_joined(layer, letter) for letter in letters)
        if red in channels and green in channels and blue in channels:
            return red, green, blue
    return None


def _luminance(layer: str, channels: Collection[str]) -> tuple[str, str, str] | None:
    grey = _joined(layer, "Y")
    alone = not any(_joined(layer, letters) in channels for letters in _NOT_LUMINANCE)
    return (grey, grey, grey) if grey in channels and alone else None


def _label(part: Part, layer: str, names: tuple[str, str, str], several: bool) -> str:
    places = [f"part {printable(part.name) or part.number}"] if several else []
    if layer and layer != part.name:
        places.append(f"layer {printable(layer)}")
    return ", ".join(places) or "the channels " + ", ".join(dict.fromkeys(names))


def _no_colour(path: str | os.PathLike[str], parts: list[Part]) -> ImageError:
    channels = [printable(name) for part in parts for name in part.sampling]
    if any(part.deep for part in parts):
        return ImageError(
            f"{path}: is a deep picture: its pixels have any number of samples; flatten it, for example with oiiotool "
            "--flatten"
        )
    if any(name.rpartition(".")[2] in ("RY", "BY") for name in channels):
        return ImageError(
            f"{path}: stores luminance and chroma ({_listed(channels)}), which is not read; save it with the channels "
            "R, G and B"
        )
    return ImageError(
        f"{path}: has no colour: expected channels R, G, B or Y, found {_listed(channels) or 'none'}; positions, "
        "normals, depths and other data are no picture"
    )


def _joined(layer: str, letters: str) -> str:
    return f"{layer}.{letters}" if layer else letters


def _listed(names: Iterable[str]) -> str:
    unique = sorted(set(names))
    more = [f"{len(unique) - _MOST_LISTED} more"] if len(unique) > _MOST_LISTED else []
    return ", ".join(unique[:_MOST_LISTED] + more)
