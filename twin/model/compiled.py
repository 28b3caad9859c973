"""How this room compiles, and what keeps numba's cache honest across files."""

import zlib
from collections.abc import Callable, Mapping
from types import CodeType
from typing import Any, TypeVar

from numba import njit
from numba.extending import register_jitable

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*signature: Any, cache: bool = False) -> Callable[[F], F]:
    """numba.njit as this room uses it, with types that survive it: a kernel that Python calls.

    Only these are cached: what they call is compiled into them, and a cached part in between would
    bring back an old version of what it calls itself.
    """
    decorator: Callable[[F], F] = njit(*signature, cache=cache, nogil=True)
    return decorator


def inner(*, inlined: bool = False) -> Callable[[F], F]:
    """A part of kernels, compiled into those that call it; for Python it stays plain Python.

    It gets no entry from Python, which would take as long to compile as the part itself.
    """
    decorator: Callable[[F], F] = register_jitable(
        nogil=True, forceinline=inlined, no_cfunc_wrapper=True
    )
    return decorator


def revision(namespace: Mapping[str, Any]) -> int:
    """A number that changes with any function or number of a module; the same in every process.

    numba's cache notices a change in a kernel's own file only. A cached kernel that calls into
    another module takes this as its last argument, by default, and so into the cache's key; or as
    a free variable, which is in the key too. (numba 0.66 takes every omitted argument of a process
    for the first one that it met, so only one number can go the first way.)
    """
    parts: list[tuple[str, ...]] = []
    for name, item in sorted(namespace.items()):
        code = getattr(getattr(item, "py_func", item), "__code__", None)
        if code is not None:
            parts.append((name, *_spelt(code)))
        elif isinstance(item, int | float):
            parts.append((name, repr(item)))
    return zlib.crc32(repr(parts).encode())


def _spelt(code: CodeType) -> tuple[str, ...]:
    """What a function does, without where it lies in memory."""
    constants = (_spelt(c) if isinstance(c, CodeType) else c for c in code.co_consts)
    return code.co_code.hex(), repr(tuple(constants)), repr(code.co_names)
