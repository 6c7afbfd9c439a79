"""Makes a function public: its arguments are checked by kind, and its signature in a tooltip is names and defaults."""

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable
from contextlib import suppress
from types import ModuleType
from typing import Any, cast, get_args

from formats.arguments import flag
from prt_bake.face.kinds import KINDS, OF_FUNCTION


def public(name: str, value: object) -> object:
    """`value` as it is handed out under the public `name`. Classes and modules only get shorter signatures."""
    if inspect.isfunction(value):
        return checked(name, value)
    if isinstance(value, ModuleType):
        for each in vars(value).values():
            if inspect.isfunction(each) and each.__module__ == value.__name__:
                cast(Any, each).__signature__ = without_types(inspect.signature(each))
    elif isinstance(value, type) and not issubclass(value, Exception):
        with suppress(ValueError):
            cast(Any, value).__signature__ = without_types(inspect.signature(value))
    return value


def checked(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its arguments checked by kind; QueryError names an argument of another kind.

    Arguments that are their default, and None where the function takes it, are not checked.
    """
    signature = inspect.signature(function)
    checks = {
        each: OF_FUNCTION.get((name, each)) or KINDS.get(each) or (flag if parameter.annotation is bool else None)
        for each, parameter in signature.parameters.items()
    }
    optional = {each for each, kind in signature.parameters.items() if type(None) in get_args(kind.annotation)}

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = None
        with suppress(TypeError):
            bound = signature.bind(*args, **kwargs)
        if bound is None:
            _refuse_misspelt(name, kwargs, signature)
            return function(*args, **kwargs)  # raises Python's own error, which names the function
        for parameter, value in bound.arguments.items():
            check = checks[parameter]
            absent = value is signature.parameters[parameter].default or (value is None and parameter in optional)
            if check is not None and not absent:
                bound.arguments[parameter] = check(parameter, value)
        return function(*bound.args, **bound.kwargs)

    # Pickled by its public name, as an argument of a process pool.
    call.__module__, call.__qualname__, call.__name__ = "prt_bake", name, name
    cast(Any, call).__signature__ = without_types(signature)
    return call


def _refuse_misspelt(name: str, given: Iterable[str], signature: inspect.Signature) -> None:
    """Raise TypeError for a keyword that is nearly the name of a parameter."""
    for each in given:
        near = difflib.get_close_matches(each, signature.parameters, 1, 0.75)
        if near and each not in signature.parameters:
            raise TypeError(f"{name}() got an unexpected keyword argument '{each}'; did you mean '{near[0]}'?")


def without_types(signature: inspect.Signature) -> inspect.Signature:
    """Names and defaults. Types of arrays are a screen long when they are expanded; docstrings give shapes instead."""
    parameters = [each.replace(annotation=inspect.Parameter.empty) for each in signature.parameters.values()]
    return inspect.Signature(parameters)
