"""Reports on bakes: the summary of one bake, and `prtbake report bake`, which compares methods and splits the error of
a picture into its parts.

May import: the rest of `prt_bake.baking`, and the rooms that it may import. Begin with `report.py`.
"""
