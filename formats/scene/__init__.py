"""Scene files and lights files (TOML): a closed object, the objects inside it, their media, and lights.

May import: `formats.mesh`, `formats.image` and the files at the top of `formats`. Begin with `record.py`; `schema.py`
lists every key.
"""

from formats.scene.record import Medium, Part, Scene, read_scene

__all__ = [
    "Medium",
    "Part",
    "Scene",
    "read_scene",
]
