"""Training rows: queries over the surface, their walks, and the buffers that hand rows to the learner.

May import: `prt_bake.network`, `prt_bake.tracer`, `prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit` and
`formats`. Begin with `rows.py`.
"""
