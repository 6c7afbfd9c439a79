"""Baked assets (HDF5): the transfer coefficients of an object, and everything an importer needs to use and check them.

May import: `formats.mesh` and the files at the top of `formats`. Begin with `record.py`, then `reader.py`; the layout
of the file is in `layout.py`.
"""

from formats.asset.reader import check_asset, read_asset
from formats.asset.record import FOLDED_IN, Asset, AssetHead, Storage
from formats.asset.writer import AssetWriter, write_asset

__all__ = ["FOLDED_IN", "Asset", "AssetHead", "AssetWriter", "Storage", "check_asset", "read_asset", "write_asset"]
