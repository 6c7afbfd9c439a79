"""Pictures by path tracing a scene under lights: the reference that baked pictures are measured against.

What is shown is what Ŝ describes, light from under the surface, with the sky behind it; light that crosses the object
without scattering is in the picture too, unless it is left out. Light reflected at the surface itself is there on
request alone.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.geometry.camera import Camera, Visibility, refuse_eye_in_object
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.rendering.loop import SHOWS_REFLECTION, Ending, Rendering, Watching, accumulate, picture_identity
from prt_bake.rendering.passes import PassTracer
from prt_bake.rendering.surface_reflection import SurfaceReflection
from prt_bake.rendering.walks import Shown, WalkTracer
from prt_bake.tracer.prepared import has_unscattered, smooth_part

__all__ = ["Rendering", "render_scene"]

SHOWS: dict[Shown, str] = {
    "all": "subsurface light, unscattered light",
    "scattered": "subsurface light, unscattered light left out",
    "unscattered": "unscattered light alone",
}
SHOWS_ROUGH = "subsurface light"
"""Of all of a scene where nothing crosses unscattered."""
_METHOD = 2
"""Raised whenever a pass sees other numbers than it did: what was begun before cannot be resumed then."""


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
    """Path trace `scene` under lights, a lat-long sky [H,W,3] or a `Lighting`, in passes of a few walks a pixel.

    It ends with the pass that reaches `spp` walks a pixel (None: no such limit), a relative noise of `error` (the root
    mean square of the standard error over the mean radiance, on the object), or `minutes`, or in which `stop` comes
    true. After the same number of passes the numbers are the same whatever ended them, and depend on the seed alone.

    `up` overrides the scene's up axis for the sky, `rotate` turns the light (degrees, counter-clockwise seen from
    above). With `reflection` the light that the surface itself reflects is added, which no bake and no network holds
    (`prt_bake.reflection.reflector`). `shown` says what of the light from under the surface: all of it, what has
    scattered (which is all that a network or an asset knows), or what crosses unscattered. The sums are kept in the
    file `checkpoint` now and then and when the work ends early; with `resume` they are taken from there. It stays: who
    has the picture safe removes it. `preview` is shown the picture so far about every `every` seconds.

    Raises QueryError below 2 walks a pixel, which have no error, for another `shown`, for an eye inside the object, and
    for a directional light without size behind a smooth interface; FormatError where `resume` finds no state or another
    picture's.
    """
    if shown not in SHOWS:
        raise QueryError(f"shown: expected {', '.join(map(repr, SHOWS))}, found {shown!r}")
    refuse_path("scene", scene, "prt.load_scene")
    ending = Ending(spp, error, minutes, stop)
    refuse_eye_in_object(scene.mesh, camera.eye)
    lighting = as_lighting(light, up or scene.up, rotate)
    _refuse_unseen(scene, lighting)
    visibility, surface = Visibility(scene.mesh), None
    if reflection:
        surface = SurfaceReflection(
            scene.mesh, lighting, scene.eta, scene.roughness, scene.normals == "vertex", visibility
        )
    walks = WalkTracer(scene, lighting, shown)
    tracer = PassTracer(scene.mesh, lighting, camera, background, walks, visibility=visibility, reflection=surface)
    identity = picture_identity(
        lighting,
        camera,
        seed,
        background,
        reflection,
        **{"method": _METHOD, "scene": scene.content_hash, "points a pass": walks.points, "shown": shown},
    )
    watching = Watching(progress, preview, every)
    picture = accumulate(tracer, camera, seed, ending, identity, checkpoint, resume, watching)
    shows = SHOWS[shown] if shown != "all" or has_unscattered(scene) else SHOWS_ROUGH
    return replace(picture, shows=shows + (SHOWS_REFLECTION if reflection else ""))


def _refuse_unseen(scene: Scene, lighting: Lighting) -> None:
    smooth = smooth_part(scene)
    if smooth is not None and any(sun.angular_diameter == 0.0 for sun in lighting.suns):
        raise QueryError(
            f"{scene.path}: behind the smooth interface of '{smooth.name}' no walk meets a directional light without "
            "size; give the light an angular diameter (the sun's is 0.53 degrees), or make the interface rough"
        )
