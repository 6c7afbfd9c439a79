"""A simulated GPU: a torch device whose tensors the CPU computes, as strict as a real one.

Its tensors do not mix with CPU tensors and have no `numpy`, as on a real GPU. Operations are executed and counted. It
says nothing about speed, and rounds as the CPU does.
"""

from collections import Counter
from functools import cache
from typing import Any

import torch
from torch.utils import backend_registration
from torch.utils._pytree import tree_leaves, tree_map

NAME = "simulated"
aten = torch.ops.aten
MAY_MIX = {aten.copy_, aten._to_copy, aten.index, aten.index_put_}
"""As on a real GPU: copies go between the devices, and index tensors may be on the CPU."""
INDEXING = {aten.index, aten.index_put_, aten.masked_select}
"""They wait for the GPU where a mask decides how many numbers there are."""
SIZES_FROM_VALUES = {aten._local_scalar_dense, aten.nonzero, aten.masked_select, aten._unique2}
VIEWS = {"view", "reshape", "expand", "select", "slice", "unsqueeze", "t", "transpose", "detach", "alias", "as_strided"}


class SimulatedTensor(torch.Tensor):
    """A tensor on the simulated GPU; `data_on_cpu` holds its values."""

    data_on_cpu: torch.Tensor

    @staticmethod
    def __new__(cls, data_on_cpu: torch.Tensor) -> "SimulatedTensor":
        with torch.inference_mode(False):
            made = torch.Tensor._make_wrapper_subclass(
                cls,
                data_on_cpu.shape,
                strides=data_on_cpu.stride(),
                storage_offset=data_on_cpu.storage_offset(),
                dtype=data_on_cpu.dtype,
                device=torch.device(NAME, 0),
            )
        made.data_on_cpu = data_on_cpu
        return made

    def __array__(self, *_how: Any) -> Any:
        raise TypeError(f"{NAME} tensors have no numpy: copy them to the CPU first")

    @classmethod
    def __torch_dispatch__(cls, operation: Any, _types: Any, args: Any = (), kwargs: Any = None) -> Any:
        leaves = tree_leaves((args, kwargs or {}))
        on_gpu = [leaf for leaf in leaves if isinstance(leaf, SimulatedTensor)]
        tensors = [leaf for leaf in leaves if isinstance(leaf, torch.Tensor) and leaf.dim()]
        on_cpu = [leaf for leaf in tensors if not isinstance(leaf, SimulatedTensor)]
        if on_cpu and operation.overloadpacket not in MAY_MIX:
            raise RuntimeError(f"{operation}: expected all tensors on one device, found some on {NAME} and some on cpu")
        if operation.overloadpacket.__name__ not in VIEWS:
            steps[operation] += 1
        masked = operation.overloadpacket in INDEXING and any(leaf.dtype == torch.bool for leaf in tensors[1:])
        if on_cpu or masked or operation.overloadpacket in SIZES_FROM_VALUES:
            waits[operation] += 1
        result = operation(*tree_map(_to_cpu, args), **tree_map(_to_cpu, kwargs or {}))
        if operation.overloadpacket in (aten.copy_, aten.index_put_):
            return args[0]
        devices = [leaf for leaf in leaves if isinstance(leaf, torch.device)]
        if devices and devices[0].type == "cpu":
            waits[operation] += 1
            return tree_map(lambda leaf: leaf.clone() if any(leaf is t.data_on_cpu for t in on_gpu) else leaf, result)
        known = {id(tensor.data_on_cpu): tensor for tensor in on_gpu}
        return tree_map(lambda leaf: known[id(leaf)] if id(leaf) in known else _on_gpu(leaf), result)


steps: Counter[Any] = Counter()
"""Operations on the GPU, each of which is a launch on a real one; views, which cost nothing, are not counted."""


waits: Counter[Any] = Counter()
"""Operations that a CUDA graph cannot record: transfers from and to the CPU."""


class _Module(backend_registration._DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


@cache
def install() -> str:
    """Registers the device, once per process, and returns its name."""
    backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=_Module())
    library = torch.library.Library("aten", "IMPL")
    library.impl("empty.memory_format", _empty, "PrivateUse1")
    library.impl("empty_strided", _empty_strided, "PrivateUse1")
    library.impl("_copy_from", _copy_from, "PrivateUse1")
    _libraries.append(library)
    return NAME


_libraries: list[torch.library.Library] = []
"""Keeps the registrations alive."""


def _to_cpu(leaf: Any) -> Any:
    if isinstance(leaf, torch.device):
        return torch.device("cpu")
    return leaf.data_on_cpu if isinstance(leaf, SimulatedTensor) else leaf


def _on_gpu(leaf: Any) -> Any:
    return SimulatedTensor(leaf) if isinstance(leaf, torch.Tensor) else leaf


def _empty(size: Any, dtype: Any = None, **_how: Any) -> SimulatedTensor:
    return SimulatedTensor(torch.empty(size, dtype=dtype))


def _empty_strided(size: Any, stride: Any, dtype: Any = None, **_how: Any) -> SimulatedTensor:
    return SimulatedTensor(torch.empty_strided(size, stride, dtype=dtype))


def _copy_from(source: torch.Tensor, target: torch.Tensor, _non_blocking: bool = False) -> torch.Tensor:
    if isinstance(source, SimulatedTensor) != isinstance(target, SimulatedTensor):
        waits["copy"] += 1
    _to_cpu(target).copy_(_to_cpu(source))
    return target
