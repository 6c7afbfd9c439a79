"""Images: linear radiance in OpenEXR, Radiance, PNG and JPEG, complete or in row blocks; textures and animations.

May import: the files at the top of `formats`. Begin with `files.py`, which selects the format by suffix.
"""

from formats.image.exr import Layers
from formats.image.files import READABLE, read_alpha, read_data, read_image, read_layers, write_image
from formats.image.png import srgb

__all__ = [
    "READABLE",
    "Layers",
    "read_alpha",
    "read_data",
    "read_image",
    "read_layers",
    "srgb",
    "write_image",
]
