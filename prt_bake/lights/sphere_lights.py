"""Sphere lights, as the object's middle sees them.

What an asset and a distant light know is light that is the same from every point of the object. From a distance d a
sphere of radius r and radiance L is a disc of angular diameter 2 asin(r/d) and radiance L: exact at the middle of the
object, and elsewhere off by parallax and falloff, which `as_disc` tells.
"""

import math
from collections.abc import Callable

import numpy as np

from formats.errors import LightError, QueryError
from formats.mesh import Mesh
from formats.scene.lights import DirectionalLight, SphereLight


def as_disc(light: SphereLight, mesh: Mesh | None, name: str, say: Callable[[str], None]) -> DirectionalLight:
    """The directional light that a sphere is, seen from the middle of `mesh`; `say` is told what that leaves out.

    The irradiance of a directional light is its radiance times its solid angle, here 2π (1 − √(1 − (r/d)²)) L. Raises
    LightError (by the light's `name`) where the sphere reaches into the ball around the object, QueryError without a
    mesh.
    """
    if mesh is None:
        raise QueryError(
            f"{name}: a sphere light is seen from the middle of an object, and there is none; hand in its mesh, or "
            "shade an asset under it"
        )
    extent = float(np.linalg.norm(mesh.positions - mesh.center, axis=1).max())
    towards = light.position - mesh.center
    distance = math.hypot(*towards)
    if distance - light.radius <= extent:
        raise LightError(
            f"{name}: the sphere at {light.position.tolist()} of radius {light.radius:g} reaches into the ball of "
            f"radius {extent:g} around the object's middle {mesh.center.tolist()}; move it away"
        )
    sine = light.radius / distance
    # 1 − cosine, which keeps its digits where the sphere is far.
    fall = sine * sine / (1.0 + math.sqrt((1.0 - sine) * (1.0 + sine)))
    say(f"{name}: {_neglected(extent / distance)}")
    return DirectionalLight(
        towards / distance, 2.0 * math.pi * fall * light.radiance, math.degrees(2.0 * math.asin(sine))
    )


def _neglected(nearness: float) -> str:
    """What lies between the light at the middle and at the rim of a ball of `nearness` times the distance."""
    turn = math.degrees(math.asin(nearness))
    return (
        f"is taken as distant, as the object's middle sees it; over the object its direction really turns by up to "
        f"{turn:.2g} degrees and its irradiance varies from {(1.0 + nearness) ** -2 - 1.0:+.1%} to "
        f"{(1.0 - nearness) ** -2 - 1.0:+.1%}"
    )
