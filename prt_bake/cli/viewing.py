"""Cameras from the options of commands that make pictures."""

from typing import Any

from prt_bake.cli.options import Point, Size


def camera_for(
    mesh: Any,
    size: Size,
    up: str,
    eye: Point | None,
    look_at: Point | None,
    fov: float,
    orthographic: bool,
    extent: float | None,
) -> Any:
    """The camera that these options ask for; an `extent` makes it orthographic."""
    from prt_bake import camera

    return camera.fit(
        mesh,
        size.width,
        size.height,
        eye=eye,
        up=up,
        fov=fov,
        target=look_at,
        orthographic=orthographic or extent is not None,
        extent=extent,
    )
