"""Sphere lights as distant discs, seen from the middle of the object.

Assets are lit by distant light, which is the same at every point of the object. A sphere of radius r and radiance L at
distance d becomes a disc of angular diameter 2 asin(r/d) and radiance L. This is exact at the middle of the object;
elsewhere parallax and falloff are neglected, and `as_disc` reports by how much.
"""

import math
from collections.abc import Callable

import numpy as np

from formats.errors import LightError, QueryError
from formats.mesh import Mesh
from formats.scene.lights import DirectionalLight, SphereLight


def as_disc(light: SphereLight, mesh: Mesh | None, name: str, say: Callable[[str], None]) -> DirectionalLight:
    """The directional light that replaces a sphere light, seen from the middle of `mesh`.

    Its irradiance is its radiance times its solid angle, 2π (1 − √(1 − (r/d)²)) L. `say` is called with the neglected
    parallax and falloff. Raises LightError (naming the light `name`) if the sphere reaches into the bounding ball of
    the object, QueryError without a mesh.
    """
    if mesh is None:
        raise QueryError(
            f"{name}: a sphere light is seen from the middle of an object, but there is no object; pass its mesh, or "
            "shade an asset under the light"
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
    # 1 − cosine keeps its digits for distant spheres.
    fall = sine * sine / (1.0 + math.sqrt((1.0 - sine) * (1.0 + sine)))
    say(f"{name}: {_neglected(extent / distance)}")
    return DirectionalLight(
        towards / distance, 2.0 * math.pi * fall * light.radiance, math.degrees(2.0 * math.asin(sine))
    )


def _neglected(nearness: float) -> str:
    """The parallax and falloff over a ball whose radius is `nearness` times the distance of the light."""
    turn = math.degrees(math.asin(nearness))
    return (
        f"is taken as distant, as seen from the object's middle; over the object its direction turns by up to "
        f"{turn:.2g} degrees and its irradiance varies from {(1.0 + nearness) ** -2 - 1.0:+.1%} to "
        f"{(1.0 - nearness) ** -2 - 1.0:+.1%}"
    )
