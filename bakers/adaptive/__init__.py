"""Bakes a block of vertices to an error: coarse view bins first, finer ones where interpolation between them fails.

May import: the files at the top of `bakers`, and `formats`. Begin with `refinement.py`.
"""
