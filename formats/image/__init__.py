"""Images: linear radiance in OpenEXR, Radiance, PNG and JPEG, whole or in blocks of rows; textures and animations.

May import: the files at the top of `formats`. Begin with `files.py`, which chooses the module of a format by suffix.
"""

from formats.image.files import READABLE, read_image, read_layers, read_levels, write_image

__all__ = [
    "READABLE",
    "read_image",
    "read_layers",
    "read_levels",
    "write_image",
]
