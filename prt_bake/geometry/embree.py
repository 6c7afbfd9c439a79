"""Embree 4 for numba kernels: one triangle mesh, one ray per call, no Python in between.

The wheel of `embreex` contains the Embree library with its C interface. Kernels get the address of `rtcIntersect1` and
the scene's handle as integers at run time, so that numba can cache their compiled code on disk.
"""

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.kernel_functions import called_function, inlined_function

_INDEX_BUFFER, _VERTEX_BUFFER = 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_ROBUST = 4
_HIGH_QUALITY = 2
_NO_HIT = np.uint32(0xFFFFFFFF)
RAY_FLOATS = 32
"""float32 words of one ray record. RTCRayHit has 96 bytes; two full cache lines avoid false sharing between threads."""

_HANDLES: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (ctypes.c_void_p, [ctypes.c_char_p]),
    "rtcReleaseDevice": (None, [ctypes.c_void_p]),
    "rtcNewScene": (ctypes.c_void_p, [ctypes.c_void_p]),
    "rtcReleaseScene": (None, [ctypes.c_void_p]),
    "rtcSetSceneFlags": (None, [ctypes.c_void_p, ctypes.c_int]),
    "rtcSetSceneBuildQuality": (None, [ctypes.c_void_p, ctypes.c_int]),
    "rtcNewGeometry": (ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_int]),
    "rtcSetNewGeometryBuffer": (ctypes.c_void_p, [ctypes.c_void_p] + [ctypes.c_int] * 3 + [ctypes.c_size_t] * 2),
    "rtcCommitGeometry": (None, [ctypes.c_void_p]),
    "rtcAttachGeometry": (ctypes.c_uint, [ctypes.c_void_p, ctypes.c_void_p]),
    "rtcReleaseGeometry": (None, [ctypes.c_void_p]),
    "rtcCommitScene": (None, [ctypes.c_void_p]),
    "rtcIntersect1": (None, [ctypes.c_void_p] * 3),
}


@cache
def _library() -> dict[str, Callable[..., Any]]:
    import embreex

    folder = Path(embreex.__file__).parent.with_name("embreex.libs")
    found = sorted(folder.glob("libembree4*")) if folder.is_dir() else []
    if not found:
        raise ImportError(f"embreex: expected libembree4 in {folder}, found none; install embreex 4.4 from a wheel")
    import embreex.rtcore_scene

    loaded = ctypes.CDLL(str(found[0]))
    functions: dict[str, Callable[..., Any]] = {}
    for name, (result, arguments) in _HANDLES.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
        functions[name] = function
    return functions


@cache
def intersect_address() -> int:
    """The address of `rtcIntersect1`, for kernels."""
    return int(ctypes.cast(_library()["rtcIntersect1"], ctypes.c_void_p).value or 0)  # type: ignore[arg-type]


class TriangleScene:
    """A committed Embree scene of one mesh, with robust traversal.

    `handle` is the address of the scene. Keep this object alive while kernels use it.
    """

    def __init__(self, positions: NDArray[np.float32], faces: NDArray[np.uint32]) -> None:
        """Build from positions float32 [V,3] and faces uint32 [F,3]."""
        call = _library()
        self._device = call["rtcNewDevice"](b"")
        self._scene = call["rtcNewScene"](self._device)
        call["rtcSetSceneFlags"](self._scene, _ROBUST)
        call["rtcSetSceneBuildQuality"](self._scene, _HIGH_QUALITY)
        geometry = call["rtcNewGeometry"](self._device, 0)
        for kind, form, rows in ((_VERTEX_BUFFER, _FLOAT3, positions), (_INDEX_BUFFER, _UINT3, faces)):
            target = call["rtcSetNewGeometryBuffer"](geometry, kind, 0, form, 12, len(rows))
            ctypes.memmove(target, np.ascontiguousarray(rows).ctypes.data, rows.nbytes)
        call["rtcCommitGeometry"](geometry)
        call["rtcAttachGeometry"](self._scene, geometry)
        call["rtcReleaseGeometry"](geometry)
        call["rtcCommitScene"](self._scene)
        self.handle = int(self._scene)

    def __del__(self) -> None:
        if getattr(self, "handle", 0):
            call = _library()
            call["rtcReleaseScene"](self._scene)
            call["rtcReleaseDevice"](self._device)
            self.handle = 0


@intrinsic
def _call_pointer(typingctx: Any, address: Any, first: Any, second: Any, third: Any) -> Any:
    signature = types.void(types.int64, types.int64, types.int64, types.int64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [word, word, word])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return signature, generate


@compiled()
def new_ray() -> Any:
    """A ray record for `nearest_hit`, aligned to 16 bytes."""
    room = np.empty(RAY_FLOATS + 4, np.float32)
    first = (room.ctypes.data // 4) % 4
    return room[(4 - first) % 4 : (4 - first) % 4 + RAY_FLOATS]


@inlined_function()
def _intersect(
    address: Any, scene: Any, ray: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any, near: Any, far: Any
) -> Any:
    words = ray.view(np.uint32)
    ray[0], ray[1], ray[2], ray[3] = ox, oy, oz, near
    ray[4], ray[5], ray[6], ray[7] = dx, dy, dz, 0.0
    ray[8] = far
    words[9] = _NO_HIT
    words[10] = np.uint32(0)
    words[11] = np.uint32(0)
    words[17] = _NO_HIT
    words[18] = _NO_HIT
    words[19] = _NO_HIT
    _call_pointer(address, scene, ray.ctypes.data, 0)  # type: ignore[call-arg]  # numba hands in the context
    return words[18] != _NO_HIT


@called_function()
def nearest_hit(address: Any, scene: Any, ray: Any, p: Any, d: Any, near: Any, far: Any, skip: Any) -> Any:
    """Nearest hit of the ray p + t d with near < t < far: (face or −1, t).

    `skip` is the face that the ray starts on (−1: none). A ray cannot hit that plane again, so such a hit is a rounding
    error. The barycentric coordinates u, v of the hit are in ray[15] and ray[16].
    """
    while _intersect(address, scene, ray, p[0], p[1], p[2], d[0], d[1], d[2], near, far):
        face = np.int64(ray.view(np.uint32)[17])
        t = np.float64(ray[8])
        if face != skip:
            return face, t
        near = t * (1.0 + 2e-7) + 1e-9
        if not near < far:
            break
    return -1, np.inf
