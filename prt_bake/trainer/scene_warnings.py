"""Warnings about scenes that are hard to learn."""

from formats.scene import Scene
from prt_bake.tracer.prepared import interface_kind
from prt_bake.tracer.surface.interface import ROUGH
from prt_bake.trainer.interior import is_clear
from prt_bake.trainer.training_data import box_of


def training_warning(scene: Scene) -> str | None:
    """Why networks of the scene will stay inexact, as a sentence; None if no reason is known."""
    if interface_kind(scene) == ROUGH and is_clear(scene, box_of(scene)):
        return (
            "the object is clear behind a rough interface: light that crosses it unscattered forms a lobe that moves "
            "with position and view, and networks learn it poorly; with roughness = 0 it is not part of the transport"
        )
    return None
