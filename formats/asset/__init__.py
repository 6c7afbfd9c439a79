"""Baked assets: the transfer coefficients of an object, with all that an importer needs to use and to check them.

The file is HDF5 with gzip and shuffle only, little-endian, of format_version 1.0:

    /             attributes format, format_version, generator, created, up, handedness, unit, colour, complete,
                  left_out (JSON)
    /mesh         positions (attribute origin, to be added), normals, tangents, faces, uv, source_vertex
    /basis        attributes kind, degree, order, sign, normalisation; check_directions, check_values
    /bins         directions; attributes rings, sectors, interpolation, solid_angle
    /transfer     coefficients [V,B,K,C], valid [V], standard_error [V,B]; attributes quantity, formula, folded_in
                  how errors hang together (`formats.asset.error_covariance`): error_covariance, error_channels,
                  error_apart, error_row
    /selftest     light, vertex, outgoing, radiance
    /provenance   json (one string), error_vs_time [rows,3]

An axis that was left out has length 1 and is broadcast: B where the view does not matter, C where the channels are
equal.
Vertices with valid = 0 were not baked: their chunks are not written and hold 0.
A compact asset has /transfer_compact in place of /transfer (`formats.asset.compact_file`, docs/compression.md).
"""

from formats.asset.reader import check_asset, read_asset
from formats.asset.record import FOLDED_IN, Asset, AssetHead, Storage
from formats.asset.writer import AssetWriter, write_asset

__all__ = ["FOLDED_IN", "Asset", "AssetHead", "AssetWriter", "Storage", "check_asset", "read_asset", "write_asset"]
