"""Sample files (HDF5): queries to the transport function of a scene and path-traced estimates, kept to train from.

May import: the files at the top of `formats`. Begin with `reader.py`, which documents the layout.
"""

from formats.samples.reader import Samples, SamplesHead, check_samples, is_samples, read_samples

__all__ = [
    "Samples",
    "SamplesHead",
    "check_samples",
    "is_samples",
    "read_samples",
]
