"""Remarks on assets that were made for one light."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any


def fixed_light(baked: Any, lights: list[str], rotate: float) -> Iterator[str]:
    """Yield a remark if an asset made for one light is shown under others, or if that light is rotated."""
    reason = next((item["reason"] for item in baked.left_out if item["item"] == "other lights"), None)
    if reason is not None and (rotate % 360.0 or (lights and not _same_light(baked, lights))):
        rotated = f"rotated by {rotate:g} degrees" if rotate % 360.0 else ""
        names = " and ".join(Path(light).name for light in lights)
        yield f"{reason}: the picture shows that light, not {' '.join(filter(None, (names, rotated)))}"


def _same_light(baked: Any, lights: list[str]) -> bool:
    from formats.atomic import sha256

    return len(lights) == 1 and Path(lights[0]).is_file() and baked.folded_in == f"light {sha256(Path(lights[0]))}"
