"""Training on a GPU: walks, training rows and learning without a copy to the processor.

May import: `prt_bake.trainer`, `prt_bake.tracer.gpu` and what these may import. Begin with `renderer.py`.
"""
