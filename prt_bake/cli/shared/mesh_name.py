"""Errors and warnings about the mesh in memory, with the name of its file."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec

from formats.errors import PrtbakeError

_Arguments = ParamSpec("_Arguments")

_IN_MEMORY = "mesh: "
"""How sentences about a mesh begin if it is an argument in Python."""


def naming_mesh(command: Callable[_Arguments, None]) -> Callable[_Arguments, None]:
    """Let the errors and warnings of a command with an argument MESH begin with its file, not with the word mesh."""

    @functools.wraps(command)
    def named(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> None:
        path = kwargs["mesh"]

        def with_file(sentence: str) -> str:
            named = path is not None and sentence.startswith(_IN_MEMORY)
            return f"{path}: {sentence.removeprefix(_IN_MEMORY)}" if named else sentence

        with warnings.catch_warnings():
            show = warnings.showwarning

            def show_with_file(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
                show(with_file(str(message)), category, *rest, **more)

            warnings.showwarning = show_with_file
            try:
                command(*args, **kwargs)
            except PrtbakeError as error:
                if (sentence := with_file(str(error))) == str(error):
                    raise
                raise type(error)(sentence) from error

    return named
