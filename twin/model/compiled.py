"""How this room compiles, and what keeps numba's cache honest across files."""

import zlib
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*signature: Any, cache: bool = False, inlined: bool = False) -> Callable[[F], F]:
    """numba.njit as this room uses it, with types that survive it; `inlined` wherever it is called.

    Cached are only the kernels that Python calls: what they call is compiled into them, and a
    cached part in between would bring back an old version of what it calls itself.
    """
    decorator: Callable[[F], F] = njit(*signature, cache=cache, nogil=True, forceinline=inlined)
    return decorator


def revision(namespace: Mapping[str, Any]) -> int:
    """A number that changes with any compiled function or number of a module.

    numba's cache notices a change in a kernel's own file only. A cached kernel that calls into
    another module takes this as its last argument, by default, and so into the cache's key; or as
    a free variable, which is in the key too. (numba 0.66 takes every omitted argument of a process
    for the first one that it met, so only one number can go the first way.)
    """
    parts: list[tuple[str, ...]] = []
    for name, item in sorted(namespace.items()):
        code = getattr(getattr(item, "py_func", None), "__code__", None)
        if code is not None:
            parts.append((name, code.co_code.hex(), repr(code.co_consts), repr(code.co_names)))
        elif isinstance(item, int | float):
            parts.append((name, repr(item)))
    return zlib.crc32(repr(parts).encode())
