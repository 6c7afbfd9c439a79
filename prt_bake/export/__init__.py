"""Exports scenes to other renderers: Mitsuba 3.

May import: `prt_bake.geometry` and `formats`. Start at `mitsuba.py`.
"""

from prt_bake.export.mitsuba import mitsuba_dictionary
from prt_bake.export.mitsuba_xml import write_mitsuba_scene

__all__ = ["mitsuba_dictionary", "write_mitsuba_scene"]
