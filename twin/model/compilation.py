"""Numba compilation of this package's kernels, and cache invalidation across files."""

import zlib
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from types import CodeType
from typing import Any, TypeVar, cast

from numba import njit, types
from numba.extending import overload, register_jitable

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


def jit_helper_unless_none(argument: str, otherwise: Callable[..., Any]) -> Callable[[F], F]:
    """As an inlined `jit_helper`, but the function is `otherwise` where `argument` is None.

    The type of the argument decides at compilation, so the case that is absent costs nothing.
    """

    def decorate(function: F) -> F:
        position = list(signature(function).parameters).index(argument)

        @wraps(function)
        def helper(*args: Any) -> Any:
            return (otherwise if args[position] is None else function)(*args)

        @overload(  # type: ignore[untyped-decorator]
            helper, strict=False, jit_options={"nogil": True, "forceinline": True}
        )
        def select(*args: Any) -> Callable[..., Any]:
            return otherwise if args[position] in (None, types.none) else function

        helper.implementations = function, otherwise  # type: ignore[attr-defined]
        return cast("F", helper)

    return decorate


def source_revision(namespace: Mapping[str, Any]) -> int:
    """Return a checksum of the functions and numbers of a module, the same in every process.

    numba's cache notices only changes in a kernel's own file. A cached kernel that calls into
    another module makes the checksum part of its cache key: as the default of its last argument,
    or as a free variable. (numba 0.66 takes the first omitted argument met in a process for all
    others, so only one number can be passed as a default.)
    """
    parts: list[tuple[str, ...]] = []
    for name, item in sorted(namespace.items()):
        functions = getattr(item, "implementations", (getattr(item, "py_func", item),))
        codes = [code for f in functions if (code := getattr(f, "__code__", None)) is not None]
        if codes:
            parts.extend((name, *_code_fingerprint(code)) for code in codes)
        elif isinstance(item, int | float):
            parts.append((name, repr(item)))
    return zlib.crc32(repr(parts).encode())


def _code_fingerprint(code: CodeType) -> tuple[str, ...]:
    """Return bytecode, constants and names of a function, without memory addresses."""
    constants = (_code_fingerprint(c) if isinstance(c, CodeType) else c for c in code.co_consts)
    return code.co_code.hex(), repr(tuple(constants)), repr(code.co_names)
