"""A graphics card that is not there: a device of torch's whose tensors the processor computes, and which is as strict.

Tensors of it and of the processor do not mix, and have no `numpy`, as on a real card; what a program does there is
done, and counted. It tells nothing of speed, and rounds as the processor does.
"""

from collections import Counter
from functools import cache
from typing import Any

import torch
from torch.utils import backend_registration
from torch.utils._pytree import tree_leaves, tree_map

NAME = "card"
aten = torch.ops.aten
MAY_MIX = {aten.copy_, aten._to_copy, aten.index, aten.index_put_}
"""As on a real card: copies go between the two, and numbers of rows may lie on the processor."""
VIEWS = {"view", "reshape", "expand", "select", "slice", "unsqueeze", "t", "transpose", "detach", "alias", "as_strided"}


class SimulatedTensor(torch.Tensor):
    """A tensor that says it is on the card; `held` has its numbers."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> "SimulatedTensor":
        with torch.inference_mode(False):
            made = torch.Tensor._make_wrapper_subclass(
                cls,
                held.shape,
                strides=held.stride(),
                storage_offset=held.storage_offset(),
                dtype=held.dtype,
                device=torch.device(NAME, 0),
            )
        made.held = held
        return made

    def __array__(self, *_how: Any) -> Any:
        raise TypeError(f"{NAME} tensors have no numpy: take them to the processor first")

    @classmethod
    def __torch_dispatch__(cls, operation: Any, _types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = tree_leaves((args, kwargs or {}))
        there = [one for one in given if isinstance(one, SimulatedTensor)]
        here = [one for one in given if isinstance(one, torch.Tensor) and not isinstance(one, SimulatedTensor) and one.dim()]
        if here and operation.overloadpacket not in MAY_MIX:
            raise RuntimeError(f"{operation}: expected all tensors on one device, found some on {NAME} and some on cpu")
        if operation.overloadpacket.__name__ not in VIEWS:
            steps[operation] += 1
        if here or operation.overloadpacket is aten._local_scalar_dense:
            waits[operation] += 1
        result = operation(*tree_map(_held, args), **tree_map(_held, kwargs or {}))
        if operation.overloadpacket in (aten.copy_, aten.index_put_):
            return args[0]
        asked = [one for one in given if isinstance(one, torch.device)]
        if asked and asked[0].type == "cpu":
            waits[operation] += 1
            return tree_map(lambda one: one.clone() if any(one is own.held for own in there) else one, result)
        known = {id(one.held): one for one in there}
        return tree_map(lambda one: known[id(one)] if id(one) in known else _on_card(one), result)


steps: Counter[Any] = Counter()
"""What was done on the card, each what a real one is asked for at a time; not counted: views, which cost nothing."""


waits: Counter[Any] = Counter()
"""What a real card cannot record to play it back: numbers that come from the processor, or go there."""


class _Module(backend_registration._DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


@cache
def install() -> str:
    """The card's name; once a process, for good."""
    backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=_Module())
    library = torch.library.Library("aten", "IMPL")
    library.impl("empty.memory_format", _empty, "PrivateUse1")
    library.impl("empty_strided", _empty_strided, "PrivateUse1")
    library.impl("_copy_from", _copy_from, "PrivateUse1")
    _kept.append(library)
    return NAME


_kept: list[torch.library.Library] = []
"""What is registered goes with its library."""


def _held(one: Any) -> Any:
    if isinstance(one, torch.device):
        return torch.device("cpu")
    return one.held if isinstance(one, SimulatedTensor) else one


def _on_card(one: Any) -> Any:
    return SimulatedTensor(one) if isinstance(one, torch.Tensor) else one


def _empty(size: Any, dtype: Any = None, **_how: Any) -> SimulatedTensor:
    return SimulatedTensor(torch.empty(size, dtype=dtype))


def _empty_strided(size: Any, stride: Any, dtype: Any = None, **_how: Any) -> SimulatedTensor:
    return SimulatedTensor(torch.empty_strided(size, stride, dtype=dtype))


def _copy_from(source: torch.Tensor, target: torch.Tensor, _non_blocking: bool = False) -> torch.Tensor:
    if isinstance(source, SimulatedTensor) != isinstance(target, SimulatedTensor):
        waits["copy"] += 1
    _held(target).copy_(_held(source))
    return target
