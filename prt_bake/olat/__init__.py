"""A test set of one object, lit by one directional light at a time (OLAT), and its scores for predicted pictures.

May import: `prt_bake.comparison`, `prt_bake.rendering` and the rooms below these in `pyproject.toml`. Begin with
`pictures.py` (cameras, lights and coordinates), then `render.py`; `score.py` stands alone.
"""
