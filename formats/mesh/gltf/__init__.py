"""glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html), `.glb` and `.gltf`: the triangles of a scene.

May import: `formats.triangle_soup` and the files at the top of `formats`. Begin with `reader.py`.

Own reader on pydantic and NumPy: trimesh 5.2 drops sparse values, morph weights, skins, instances, visibility and fans,
and reads required extensions that it does not know; pygltflib parses the JSON, but reads no accessor.
"""

import os

from formats.mesh.gltf.names import named_files
from formats.triangle_soup import TriangleSoup


def read_gltf(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read the triangles of a glTF file in its default pose; see `formats.mesh.gltf.reader.read_scene`."""
    from formats.mesh.gltf.reader import read_scene  # here, since pydantic takes long to load

    return read_scene(path)


__all__ = ["named_files", "read_gltf"]
