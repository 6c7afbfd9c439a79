"""Cameras from the options of the commands that make pictures."""

from typing import Any

import typer

from prt_bake.cli.shared.options import USUAL_FOV, Point, Size


def refuse_view_and_eye(view: str | None, eye: Point | None) -> None:
    """Raise typer.BadParameter if both place the camera."""
    if view is not None and eye is not None:
        raise typer.BadParameter("--view: --eye places the camera; omit one of them")


def camera_for(
    mesh: Any,
    size: Size,
    up: str,
    view: Any,
    eye: Point | None,
    look_at: Point | None,
    fov: float,
    orthographic: bool,
    extent: float | None,
    turns: int = 1,
) -> Any:
    """Return the camera of these options; an `extent` makes it orthographic. `turns` is as in `camera.fit`.

    Raises typer.BadParameter for an orthographic camera with a field of view, and for a view beside an eye.
    """
    refuse_view_and_eye(view, eye)
    parallel = orthographic or extent is not None
    if parallel and fov != USUAL_FOV:
        raise typer.BadParameter(
            f"--fov: an orthographic camera has no field of view; omit --fov or "
            f"{'--orthographic' if extent is None else '--extent'}"
        )
    from prt_bake.geometry import camera

    return camera.fit(
        mesh,
        size.width,
        size.height,
        eye=eye,
        up=up,
        fov=fov,
        view=view,
        target=look_at,
        orthographic=parallel,
        extent=extent,
        turns=turns,
    )
