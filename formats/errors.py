"""The errors that a user can cause, and warnings about input that is read all the same.

Each message is one sentence: file, place, expected, found, remedy.
"""

import os
import warnings


class InputWarning(UserWarning):
    """Input that can be read in several ways, or of which a part is ignored; the message says what was done."""


class PrtbakeError(Exception):
    """The base class of every error that a user can cause.

    >>> import prt_bake as prt
    >>> try:
    ...     prt.read_mesh("missing.ply")
    ... except prt.PrtbakeError as error:
    ...     print(error)
    missing.ply: there is no such file; check the name and the folder
    """


class FormatError(PrtbakeError, ValueError):
    """A file whose content is not what its format requires."""


class MeshError(FormatError):
    """A mesh file that cannot be read, or a surface that cannot be used."""


class ImageError(FormatError):
    """An image that cannot be read or written."""


class SceneError(FormatError):
    """A scene file with an unknown key, a value out of range, or a mesh or grid that does not fit."""


class LightError(FormatError):
    """An invalid light: an unknown key, a direction without length, a negative irradiance."""


class AssetError(FormatError):
    """An asset that is truncated, of another version, or inconsistent."""


class ModelError(FormatError):
    """A network file that is damaged, unsafe to load or of the wrong kind."""


class SamplesError(FormatError):
    """A sample file that is truncated, of another version or scene, or inconsistent."""


class QueryError(PrtbakeError, ValueError):
    """An argument outside its domain: points off the surface, directions below the horizon, wrong shapes."""


class StorageError(PrtbakeError, OSError):
    """A path that cannot be read or written: disk full, permission missing, folder missing."""


class ClusterError(PrtbakeError, RuntimeError):
    """A cluster that cannot be reached or was lost, or whose workers fail."""


def refuse_path(name: str, value: object, reader: str) -> None:
    """Raise QueryError if the argument `name` is a path instead of the object that `reader` returns for it."""
    if isinstance(value, str | os.PathLike):
        raise QueryError(
            f"{name}: expected what {reader}(path) returns, found the path {os.fspath(value)}; read the file first"
        )


def warn(sentence: str) -> None:
    """Issue an InputWarning; the command line prints it as one line on standard error."""
    warnings.warn(sentence, InputWarning, stacklevel=2)
