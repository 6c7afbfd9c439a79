"""The demo: a scene, a model and a sky as package data, how they were made, and what `prtbake demo` does.

May import: every room but `cli`, `paper` and `preview`. Begin with `demonstration.py`.
"""
