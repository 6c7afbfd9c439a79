"""Exports to other programs: assets to engines (glTF, textures) and browsers (a page), scenes to Mitsuba 3.

May import: `prt_bake.inspection`, `prt_bake.shipped`, `prt_bake.shading`, `prt_bake.lights` and what lies below them.
Start at `engine_form.py` and `gltf.py`; `site.py` writes the page whose files are in `page/`.
"""

from prt_bake.export.mitsuba import mitsuba_dictionary
from prt_bake.export.mitsuba_xml import write_mitsuba_scene

__all__ = ["mitsuba_dictionary", "write_mitsuba_scene"]
