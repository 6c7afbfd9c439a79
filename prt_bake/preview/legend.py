"""Words of the window: which keys there are, and what is shown."""

import textwrap

from numpy.typing import ArrayLike

from prt_bake.preview.state import Mode, Preview
from prt_bake.shading.suns import SunTreatment

_LETTER = 8
"""Pixels that a letter takes, about."""

_SUNS: dict[SunTreatment, str] = {"split": "suns apart", "window": "suns damped", "plain": "suns as harmonics"}

Key = tuple[str, str]


def keys(preview: Preview, reference: str | None) -> list[Key]:
    """Names of keys and what they do, those alone that do something for this asset."""
    rows = [("drag", "orbit"), ("wheel", "nearer, farther"), ("shift drag", "move sideways"), ("0", "first view")]
    if preview.relightable:
        rows.append(("left right", "turn the light"))
    rows.append(("up down", "exposure"))
    if len(preview.lights) > 1:
        rows.append(("n", f"next light, of {len(preview.lights)}"))
    if preview.relightable:
        rows.append(("drop", "a sky on the window: one light more"))
    if preview.interface is not None and preview.lights:
        rows.append(("r", "reflection of the surface"))
    if preview.lights:
        rows.append(("b", "sky behind the object"))
    if preview.has_suns:
        rows.append(("u", "suns apart, or as harmonics like all light"))
    rows += [("e", "standard error"), ("v", "valid vertices"), ("c", "coefficients"), (", .", "previous, next of them")]
    if reference is not None:
        rows.append(("space", f"flip to {reference}"))
    return [*rows, ("s", "save the picture"), ("h", "hide this"), ("q", "quit")]


def legend(preview: Preview, reference: str | None) -> str:
    """The keys as lines of text, for a font of one width."""
    rows = keys(preview, reference)
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {words}" for name, words in rows)


def wrapped(words: str, width: int) -> str:
    """A sentence in lines that a window of this width in pixels has room for."""
    return "\n".join(textwrap.wrap(words, max(20, width // _LETTER)))


def status(preview: Preview, name: str, eye: ArrayLike, reference: str | None = None) -> str:
    """One line: the asset, or the picture to compare with, and what of it is shown to this eye under which light."""
    exposure = f"{preview.exposure:+.2g} EV" if preview.exposure else ""
    if reference is not None:
        return _joined(reference, exposure)
    if preview.mode is Mode.VALID:
        missing = int((~preview.asset.valid).sum())
        return _joined(name, f"{missing} of {len(preview.asset.valid)} vertices not valid" if missing else "all valid")
    light = preview.lights[preview.current].name if preview.lights else "the light it was made for"
    turned = f"turned {preview.rotation:+.0f}°" if preview.rotation else ""
    if preview.mode is Mode.COEFFICIENT:
        l, m = preview.degree_and_order
        return _joined(name, f"coefficient l = {l}, m = {m}")
    if preview.mode is Mode.ERROR:
        return _joined(name, "standard error", light, turned)
    suns = preview.suns_shown(eye)
    return _joined(
        name,
        light,
        turned,
        exposure,
        "" if suns is None else _SUNS[suns],
        "with reflection" if preview.reflected_sky is not None else "",
        "loading kernels" if preview.loading else "",
    )


def _joined(*parts: str) -> str:
    return "   ".join(part for part in parts if part)
