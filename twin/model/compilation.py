"""Numba compilation of this package's kernels, and cache invalidation across files."""

import zlib
from collections.abc import Callable, Mapping
from types import CodeType
from typing import Any, TypeVar

from numba import njit
from numba.extending import register_jitable

F = TypeVar("F", bound=Callable[..., Any])


def jit_kernel(*signature: Any, cache: bool = False) -> Callable[[F], F]:
    """Compile a kernel that Python calls with numba.njit, keeping its type annotations.

    Only kernels are cached. Helpers are compiled into them: a cached helper could bring back an
    outdated version of another helper that it calls.
    """
    decorator: Callable[[F], F] = njit(*signature, cache=cache, nogil=True)
    return decorator


def jit_helper(*, inlined: bool = False) -> Callable[[F], F]:
    """Mark a helper for compilation into the kernels that call it; Python runs it uncompiled.

    It has no compiled entry point from Python, which would double its compilation time.
    """
    decorator: Callable[[F], F] = register_jitable(
        nogil=True, forceinline=inlined, no_cfunc_wrapper=True
    )
    return decorator


def source_revision(namespace: Mapping[str, Any]) -> int:
    """Return a checksum of the functions and numbers of a module, the same in every process.

    numba's cache notices only changes in a kernel's own file. A cached kernel that calls into
    another module makes the checksum part of its cache key: as the default of its last argument,
    or as a free variable. (numba 0.66 takes the first omitted argument met in a process for all
    others, so only one number can be passed as a default.)
    """
    parts: list[tuple[str, ...]] = []
    for name, item in sorted(namespace.items()):
        code = getattr(getattr(item, "py_func", item), "__code__", None)
        if code is not None:
            parts.append((name, *_code_fingerprint(code)))
        elif isinstance(item, int | float):
            parts.append((name, repr(item)))
    return zlib.crc32(repr(parts).encode())


def _code_fingerprint(code: CodeType) -> tuple[str, ...]:
    """Return bytecode, constants and names of a function, without memory addresses."""
    constants = (_code_fingerprint(c) if isinstance(c, CodeType) else c for c in code.co_consts)
    return code.co_code.hex(), repr(tuple(constants)), repr(code.co_names)
