"""Scenes for other renderers. Today: Mitsuba 3.

May import: `prt_bake.geometry` and `formats`. Begin with `mitsuba.py`.
"""
