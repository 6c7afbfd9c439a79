"""Files on disk: meshes, images, scenes, samples and assets, each a frozen record with a reader and a writer.

May import: nothing else of the product. Begin with `errors.py` and `atomic.py`, which every reader and writer uses.
"""
