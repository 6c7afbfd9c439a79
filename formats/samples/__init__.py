"""Sample files (HDF5): queries of a scene's transport function with path-traced estimates, for training.

May import: the files at the top of `formats`. Begin with `reader.py`, which documents the layout of the file.
"""

from formats.samples.reader import Samples, SamplesHead, check_samples, is_samples, read_samples

__all__ = [
    "Samples",
    "SamplesHead",
    "check_samples",
    "is_samples",
    "read_samples",
]
