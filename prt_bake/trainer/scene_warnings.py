"""Warnings about scenes that are hard to learn."""

import numpy as np

from formats.scene import Scene
from prt_bake.tracer.prepared import interface_kind
from prt_bake.tracer.surface.interface import ROUGH

_CLEAR = 4.0
"""Optical depth along the object's longest side below which more than a fiftieth of the light crosses unscattered."""


def training_warning(scene: Scene) -> str | None:
    """Why networks of the scene will stay inexact, as a sentence; None if no reason is known."""
    side = float(np.ptp(scene.mesh.bounds, axis=0).max())
    if interface_kind(scene) == ROUGH and float(np.mean(scene.medium.sigma_t)) * side < _CLEAR:
        return (
            "the object is clear behind a rough interface: light that crosses it unscattered forms a lobe that moves "
            "with position and view, and networks learn it poorly; with roughness = 0 it is not part of the transport"
        )
    return None
