"""Pictures by path tracing a scene under lights: the reference for baked pictures.

A picture shows light from under the surface, as described by Ŝ, and the sky behind the object. It includes light that
crosses the object without scattering, unless `shown` excludes it, and light reflected at the surface on request.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.geometry.camera import Camera, Visibility, refuse_eye_in_object
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.reflection.finish import Normals
from prt_bake.rendering.loop import (
    SHOWS_REFLECTION,
    Observers,
    Rendering,
    StopCriteria,
    accumulate,
    picture_identity,
    required_checkpoint,
)
from prt_bake.rendering.passes import PassTracer
from prt_bake.rendering.surface_reflection import SurfaceReflection, reflection_identity
from prt_bake.rendering.walks import Shown, WalkTracer
from prt_bake.tracer.prepared import has_unscattered, no_values_reason

__all__ = ["Rendering", "render_scene"]

SHOWS: dict[Shown, str] = {
    "all": "subsurface light, unscattered light",
    "scattered": "subsurface light, unscattered light left out",
    "unscattered": "unscattered light alone",
}
SHOWS_ROUGH = "subsurface light"
"""For "all" of a scene without unscattered light."""
_METHOD = 2
"""Version of the numbers of a pass; older checkpoints cannot be resumed."""


def render_scene(
    scene: Scene,
    light: ArrayLike | Lighting,
    camera: Camera,
    spp: int | None = 64,
    seed: int = 0,
    *,
    up: str | None = None,
    rotate: float = 0.0,
    background: bool = True,
    reflection: bool = False,
    normals: Normals | None = None,
    shown: Shown = "all",
    error: float | None = None,
    minutes: float | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[float], None] | None = None,
    preview: Callable[[Rendering], None] | None = None,
    every: float = 10.0,
) -> Rendering:
    """Path trace `scene` under lights, a lat-long sky [H,W,3] or a `Lighting`, in passes of a few walks per pixel.

    The work ends after the pass that reaches `spp`, `error` or `minutes`, or during which `stop` returns True. The
    result depends only on the seed and the number of passes.

    Args:
        scene: the scene.
        light: a `Lighting` or a lat-long picture of radiance.
        camera: the view.
        spp: walks per pixel (None: no limit).
        seed: of all random numbers.
        up: overrides the scene's up axis for the sky.
        rotate: rotates the light (degrees, counter-clockwise seen from above).
        background: whether the sky is visible behind the object.
        reflection: adds the light reflected at the surface, which bakes and networks do not contain
            (`prt_bake.reflection.reflector`).
        normals: those of the reflection, as in `prt_bake.render_picture`; paths are refracted by the scene's own.
        shown: the light from under the surface: "all", "scattered" (as in networks and assets) or "unscattered".
        error: relative noise: rms of the standard error over the mean radiance, on the object.
        minutes: time limit.
        checkpoint: a file for the sums, written regularly and when the work ends early; the caller removes it.
        resume: continues from the checkpoint.
        stop: ends the work when it returns True.
        progress: called with the finished share.
        preview: called with the current picture about every `every` seconds.

    Raises QueryError for less than 2 walks per pixel, for another `shown`, for an eye inside the object, and for a
    directional light without size behind a smooth interface, and for `resume` without `checkpoint`. Raises FormatError
    if there is no such file to resume, or if it belongs to another picture.

    >>> import prt_bake as prt
    >>> scene = prt.load_scene("spot.toml")
    >>> camera = prt.fit_camera(scene.mesh, 32, 24)
    >>> picture = prt.render_scene(scene, prt.read_lighting("sky.hdr"), camera, spp=4)
    >>> picture.image.shape
    (24, 32, 3)
    """
    if shown not in SHOWS:
        raise QueryError(f"shown: expected {', '.join(map(repr, SHOWS))}, found {shown!r}")
    refuse_path("scene", scene, "prt.load_scene")
    criteria = StopCriteria(spp, error, minutes, stop)
    if resume:
        required_checkpoint(checkpoint)
    refuse_eye_in_object(scene.mesh, camera.eye)
    lighting = as_lighting(light, up or scene.up, rotate)
    _refuse_hidden_suns(scene, lighting)
    visibility, surface = Visibility(scene.mesh), None
    if reflection:
        surface = SurfaceReflection(scene.mesh, lighting, scene.eta, scene.roughness, normals, visibility)
    walks = WalkTracer(scene, lighting, shown)
    tracer = PassTracer(scene.mesh, lighting, camera, background, walks, visibility=visibility, reflection=surface)
    identity = picture_identity(
        lighting,
        camera,
        seed,
        background,
        reflection,
        **reflection_identity(surface),
        **{"method": _METHOD, "scene": scene.content_hash, "points a pass": walks.points, "shown": shown},
    )
    observers = Observers(progress, preview, every)
    picture = accumulate(tracer, camera, seed, criteria, identity, checkpoint, resume, observers)
    shows = SHOWS[shown] if shown != "all" or has_unscattered(scene) else SHOWS_ROUGH
    return replace(picture, shows=shows + (SHOWS_REFLECTION if reflection else ""))


def _refuse_hidden_suns(scene: Scene, lighting: Lighting) -> None:
    if (reason := no_values_reason(scene)) and any(sun.angular_diameter == 0.0 for sun in lighting.suns):
        raise QueryError(
            f"{scene.path}: {reason}; paths cannot hit a directional light without size there; give the light an "
            "angular diameter (the sun's is 0.53 degrees)"
        )
