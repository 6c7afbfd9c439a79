"""Why a key of the window would change nothing: one sentence, or "" for a key that has an effect."""

from prt_bake.preview.state import Mode, Preview

_MADE_FOR_ONE_LIGHT = "the asset was made for one light"


def of_other_lights(preview: Preview) -> str:
    """Return why there is no next light."""
    alone = "" if len(preview.lights) > 1 else "there is one light: drop a sky on the window to add one"
    return of_rotation(preview) or alone


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
    return of_tone_map(preview) if preview.has_suns else "no suns: this light has no small strong sources"


def of_tone_map(preview: Preview) -> str:
    """Return why false colours are shown, which have no light."""
    keys = {Mode.ERROR: "e", Mode.VALID: "v", Mode.COEFFICIENT: "c"}
    return f"not in this view: {keys[preview.mode]} returns to the light" if preview.mode in keys else ""


def _of_sky(preview: Preview, what: str) -> str:
    if preview.light is None:
        return f"{what}: {_MADE_FOR_ONE_LIGHT}"
    if preview.light.picture is None:
        return f"{what}: {preview.lights[preview.current].name} has no sky"
    return of_tone_map(preview)
