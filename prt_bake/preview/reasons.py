"""Why a key of the window would change nothing: one sentence, or "" for a key that has an effect."""

from prt_bake.preview.state import Mode, Preview

_MADE_FOR_ONE_LIGHT = "the asset was made for one light"


def of_other_lights(preview: Preview) -> str:
    """Return why there is no next light."""
    if not preview.relightable:
        return _MADE_FOR_ONE_LIGHT
    return "" if len(preview.lights) > 1 else "there is one light: drop a sky on the window to add one"


def of_rotation(preview: Preview) -> str:
    """Return why the light cannot be rotated."""
    return "" if preview.relightable else _MADE_FOR_ONE_LIGHT


def of_reflection(preview: Preview) -> str:
    """Return why there is no reflection."""
    if preview.interface is None:
        return "no reflection: the object's index of refraction is 1"
    return _of_sky(preview, "no reflection")


def of_background(preview: Preview) -> str:
    """Return why there is no sky behind the object."""
    return _of_sky(preview, "no background")


def of_suns(preview: Preview) -> str:
    """Return why there are no suns to treat in another way."""
    if not preview.has_suns:
        return "no suns: this light has no small strong sources"
    return _of_mode(preview)


def of_tone_map(preview: Preview) -> str:
    """Return why there is nothing to tone map."""
    return _of_mode(preview)


def _of_sky(preview: Preview, what: str) -> str:
    if preview.light is None:
        return f"{what}: {_MADE_FOR_ONE_LIGHT}"
    if preview.light.picture is None:
        return f"{what}: {preview.lights[preview.current].name} has no sky"
    return _of_mode(preview)


def _of_mode(preview: Preview) -> str:
    keys = {Mode.ERROR: "e", Mode.VALID: "v", Mode.COEFFICIENT: "c"}
    return f"not in this view: {keys[preview.mode]} returns to the light" if preview.mode in keys else ""
