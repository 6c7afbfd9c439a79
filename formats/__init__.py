"""What lies on disk: meshes, images, scenes and assets, each a frozen record with a reader and a writer.

Nothing here computes light, and nothing here imports from the rest of the product.
"""
