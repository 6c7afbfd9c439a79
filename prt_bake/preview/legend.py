"""Texts of the window: the keys and the status line."""

import textwrap

from numpy.typing import ArrayLike

from prt_bake.preview.state import Mode, Preview

_LETTER = 8
"""Approximate width of a letter in pixels."""

_SUNS = {
    "split": "suns split",
    "window": "suns damped",
    "plain": "suns in harmonics",
    "lobes": "lobes",
}

Key = tuple[str, str]


def keys(preview: Preview, reference: str | None) -> list[Key]:
    """Return the keys that apply to this asset, with their actions."""
    rows = [("drag", "orbit"), ("wheel", "zoom"), ("shift drag", "pan"), ("0", "initial view")]
    if preview.relightable:
        rows.append(("left right", "rotate the light"))
    rows.append(("up down", "exposure"))
    if len(preview.lights) > 1:
        rows.append(("n", f"next light of {len(preview.lights)}"))
    if preview.relightable:
        rows.append(("drop", "a sky on the window: adds a light"))
    if preview.interface is not None and preview.lights:
        rows.append(("r", "surface reflection"))
    if preview.lights:
        rows.append(("b", "sky behind the object"))
    if preview.has_suns:
        rows.append(("u", "suns split off or lobes, or harmonics alone"))
    rows.append(("t", "AgX tone map, as in Blender"))
    rows += [("e", "standard error"), ("v", "valid vertices"), ("c", "coefficients"), (", .", "previous, next one")]
    if reference is not None:
        rows.append(("space", f"flip to {reference}"))
    return [*rows, ("s", "save the picture"), ("h", "hide this"), ("q", "quit")]


def legend(preview: Preview, reference: str | None) -> str:
    """Return the keys as lines of text for a monospaced font."""
    rows = keys(preview, reference)
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {action}" for name, action in rows)


def wrapped(text: str, width: int) -> str:
    """Wrap a text to the width of a window in pixels."""
    return "\n".join(textwrap.wrap(text, max(20, width // _LETTER)))


def status(preview: Preview, name: str, eye: ArrayLike, reference: str | None = None) -> str:
    """Return the status line: asset (or reference picture), mode, light, exposure and suns."""
    exposure = f"{preview.exposure:+.2g} EV" if preview.exposure else ""
    if reference is not None:
        return _joined(reference, exposure)
    if preview.mode is Mode.VALID:
        missing = int((~preview.asset.valid).sum())
        return _joined(name, f"{missing} of {len(preview.asset.valid)} vertices not valid" if missing else "all valid")
    light = preview.lights[preview.current].name if preview.lights else "the light it was made for"
    rotated = f"rotated {preview.rotation:+.0f}°" if preview.rotation else ""
    if preview.mode is Mode.COEFFICIENT:
        l, m = preview.degree_and_order
        return _joined(name, f"coefficient l = {l}, m = {m}")
    if preview.mode is Mode.ERROR:
        return _joined(name, "standard error relative to the radiance", light, rotated)
    suns = preview.suns_shown(eye)
    return _joined(
        name,
        light,
        rotated,
        exposure,
        "" if suns is None else _SUNS[suns],
        "AgX" if preview.shown_tone_map == "agx" else "",
        "with reflection" if preview.reflected_sky is not None else "",
        "loading kernels" if preview.loading else "",
    )


def _joined(*parts: str) -> str:
    return "   ".join(part for part in parts if part)
