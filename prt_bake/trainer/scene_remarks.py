"""What is worth knowing of a scene before it is learnt."""

import numpy as np

from formats.scene import Scene

_CLEAR = 4.0
"""Optical depths of the object's longest side, behind which a fiftieth of the light is left unscattered."""


def hard_to_learn(scene: Scene) -> str | None:
    """A sentence on what keeps networks of the scene from being exact; None where nothing is known to."""
    side = float(np.ptp(scene.mesh.bounds, axis=0).max())
    bends_roughly = float(scene.eta) != 1.0 and float(np.mean(scene.roughness)) > 0.0
    if bends_roughly and float(np.mean(scene.medium.sigma_t)) * side < _CLEAR:
        return (
            "the object is clear behind a rough interface: light that crosses it without being scattered counts, as a "
            "lobe that moves with place and view and that networks hardly learn; with roughness = 0 it is left out"
        )
    return None
