"""File formats: meshes, images, scenes, samples and assets, each with a record in memory, a reader and its checks.

May import: nothing else of the product. Begin with `errors.py` and `atomic.py`, which every reader and writer uses.
"""
