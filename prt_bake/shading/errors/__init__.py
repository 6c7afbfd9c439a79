"""Errors of the radiance that an asset gives: of pictures in one figure, of vertices, of interpolation over faces.

May import: `prt_bake.shading` and the rooms below it in `pyproject.toml`. Begin with `picture.py`.
"""
