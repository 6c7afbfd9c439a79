"""`prtbake report bake`: error against time for each method, and the error budget of a picture.

May import: the rest of `prt_bake.baking`, `prt_bake.reflection` and `prt_bake.lights`. Begin with `report.py`.
"""
