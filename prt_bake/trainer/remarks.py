"""What is worth knowing of a scene before it is learnt."""

from formats.scene import Scene
from prt_bake.trainer.interface import ROUGH
from prt_bake.trainer.interior import is_clear
from prt_bake.trainer.material import box_of
from prt_bake.trainer.prepared import interface_kind


def hard_to_learn(scene: Scene) -> str | None:
    """A sentence on what keeps networks of the scene from being exact; None where nothing is known to."""
    if interface_kind(scene) == ROUGH and is_clear(scene, box_of(scene)):
        return (
            "the object is clear behind a rough interface: light that crosses it without being scattered counts, as a "
            "narrow lobe that a network hardly learns; with roughness = 0 it is left out"
        )
    return None
