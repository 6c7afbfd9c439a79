"""Adaptive bakes of a whole object, to a requested error or within a time.

`bakers.adaptive` refines one block of vertices to given tolerances. This package chooses the tolerances and runs blocks
in passes. `noise_pilot.py` and `survey.py` measure before the first pass; `trials.py`, `tolerances.py` and
`parent_vertices.py` choose the settings of a pass; `passes.py` runs one, with `interpolation.py` for fine meshes;
`pass_asset.py` writes its asset; `pilot_pass.py` predicts its cost for plans.
May import: `bakers.adaptive`, `prt_bake.baking.job`, `.pruning`, `.output`, and the rooms that these may import.
Begin with `run.py`.
"""
