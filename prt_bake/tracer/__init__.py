"""The reference path tracer: a random walk inside the object, and estimates of its transport function.

`volume` follows light through media, `surface` handles interfaces and rays. Nothing here learns. May import:
`prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `estimate.py`, then `walk.py`.
"""
