"""The preview window: an asset under any light, seen from anywhere.

May import: `prt_bake.shading`, `prt_bake.lights` and the rooms below. Begin with `window.py`.
"""
