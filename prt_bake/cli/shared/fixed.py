"""Remarks on assets that were made for one light or one eye."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any


def fixed_light(baked: Any, lights: list[str], rotate: float) -> Iterator[str]:
    """Yield a remark if an asset made for one light is shown under others, or if that light is rotated."""
    reason = _reasons(baked).get("other lights")
    if reason is not None and (rotate % 360.0 or (lights and not _same_light(baked, lights))):
        rotated = f"rotated by {rotate:g} degrees" if rotate % 360.0 else ""
        names = " and ".join(Path(light).name for light in lights)
        yield f"{reason}: the picture shows that light, not {' '.join(filter(None, (names, rotated)))}"


def fixed_view(baked: Any, eye: Any = None) -> Iterator[str]:
    """Yield a remark if an asset made for one eye is shown from another one, or from any if there is no `eye`."""
    made_for = baked.provenance.get("settings", {}).get("for_eye")
    if made_for is None:
        return
    if eye is None or any(abs(a - b) > 1e-6 * (1.0 + abs(b)) for a, b in zip(eye, made_for, strict=True)):
        reason = _reasons(baked).get("other views", "made for one position")
        yield f"{reason}: from other positions its colours are wrong"


def _reasons(baked: Any) -> dict[str, str]:
    return {item["item"]: item["reason"] for item in baked.left_out}


def _same_light(baked: Any, lights: list[str]) -> bool:
    from formats.atomic import sha256

    return len(lights) == 1 and Path(lights[0]).is_file() and baked.folded_in == f"light {sha256(Path(lights[0]))}"
