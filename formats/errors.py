"""Every fault that a user can cause, each told in one clear sentence."""

import os


class PrtbakeError(Exception):
    """A fault that a user can cause; `str()` says which file, where, expected, found, what to do."""


class FormatError(PrtbakeError, ValueError):
    """A file that is not what it should be."""


class MeshError(FormatError):
    """A mesh that cannot be read, or whose surface cannot be used."""


class ImageError(FormatError):
    """An image that cannot be read or written."""


class SceneError(FormatError):
    """A scene file with an unknown key, a value out of range, or a mesh or grid that does not fit."""


class LightError(FormatError):
    """A light that is none: an unknown key, a direction without length, a negative irradiance."""


class AssetError(FormatError):
    """An asset that is truncated, of another version, or at odds with itself."""


class ModelError(FormatError):
    """A network file that is damaged, hostile or of the wrong kind."""


class SamplesError(FormatError):
    """A file of samples that is truncated, of another version or scene, or at odds with itself."""


class QueryError(PrtbakeError, ValueError):
    """Arguments out of their domain: points off the surface, directions below the horizon, wrong shapes."""


class StorageError(PrtbakeError, OSError):
    """A place that cannot be read from or written to: disk full, permission missing, folder missing."""


class ClusterError(PrtbakeError, RuntimeError):
    """A cluster that cannot be reached, that has gone, or whose workers are not fit for the work."""


def refuse_path(name: str, value: object, reader: str) -> None:
    """Raise QueryError where the argument `name` is a path instead of what `reader` makes of it."""
    if isinstance(value, str | os.PathLike):
        raise QueryError(f"{name}: the path {os.fspath(value)} where what it holds is expected; use {reader}(path)")
