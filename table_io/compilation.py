"""Numba compilation of kernels, and a cache on disk that follows all the code in a kernel."""

import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from enum import Enum
from functools import cache as compute_once
from functools import wraps
from inspect import signature
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

from numba import njit, types
from numba.core.caching import FunctionCache
from numba.extending import overload, register_jitable

F = TypeVar("F", bound=Callable[..., Any])

SOURCE_MARKER = "source.txt"  # in a folder of compiled kernels: the folder of their source files
# Their functions are replaced by numba's own, which numba's version in the cache stands for.
_REPLACED_PACKAGES = frozenset({"builtins", "cmath", "math", "numba", "numpy"})


def jit_kernel(*signatures: Any, cache: bool = False) -> Callable[[F], F]:
    """Compile a kernel that Python calls with numba.njit, keeping its type annotations.

    With `cache` it is kept on disk until its own file changes, or a function or constant that is
    compiled into it, in whatever file. Where no folder can be written it is compiled every time.
    """

    def decorate(function: F) -> F:
        kernel: Any = njit(nogil=True)(function)
        if not hasattr(kernel, "py_func"):
            return function  # NUMBA_DISABLE_JIT
        if cache:
            with suppress(RuntimeError):  # no folder for the cache can be written
                kernel._cache = _KernelCache(function)
        for each in signatures:
            for one_signature in each if isinstance(each, list) else [each]:
                kernel.compile(one_signature)
        if signatures:
            kernel.disable_compile()
        return cast("F", kernel)

    return decorate


def jit_untyped_kernel(function: Callable[..., Any]) -> Any:
    """Compile a kernel without type annotations and keep it on disk, see `jit_kernel`."""
    return jit_kernel(cache=True)(function)


# Marks a helper of kernels that Python never calls.
inline_jit = njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def jit_helper(*, inlined: bool = False) -> Callable[[F], F]:
    """Mark a helper for compilation into the kernels that call it; Python runs it uncompiled.

    It has no compiled entry point from Python, which would double its compilation time.
    """
    decorator: Callable[[F], F] = register_jitable(
        nogil=True, forceinline=inlined, no_cfunc_wrapper=True
    )
    return decorator


def jit_untyped_helper(function: Callable[..., Any]) -> Any:
    """Mark a helper without type annotations, see `jit_helper`."""
    return jit_helper()(function)


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


def fingerprint_kernel(kernel: Callable[..., Any]) -> str:
    """Return a digest of a kernel and of all that is compiled into it, the same in every process.

    Follows the global names, closures and defaults of the function to functions and constants of
    any module, and on from there. Functions of numpy and the standard mathematics end the search.
    """
    digest = hashlib.sha256()
    for part in _describe_item(kernel, set()):
        digest.update(part.encode())
        digest.update(b"\0")
    return digest.hexdigest()


def _describe_item(item: Any, visited: set[int]) -> Iterator[str]:
    """Yield texts that change with a function, constant or module that a kernel uses."""
    if isinstance(item, bool | int | float | complex | str | bytes | Enum | None):
        yield repr(item)
    elif isinstance(item, tuple):
        yield type(item).__qualname__
        for element in item:
            yield from _describe_item(element, visited)
    elif isinstance(item, type):
        yield f"{item.__qualname__} {getattr(item, '_fields', None)}"
        yield from _describe_item(tuple(getattr(item, "_field_defaults", {}).values()), visited)
    elif hasattr(item, "tobytes"):  # arrays and numbers of numpy
        yield f"{item.dtype} {item.shape} {item.tobytes().hex()}"
    else:
        # What is compiled: of dispatchers their function, of choices by type all that are chosen.
        for function in getattr(item, "implementations", (getattr(item, "py_func", item),)):
            if isinstance(function, FunctionType):
                yield from _describe_function(function, visited)
            else:
                yield type(function).__qualname__


def _describe_function(function: FunctionType, visited: set[int]) -> Iterator[str]:
    yield function.__qualname__
    if id(function) in visited or _is_replaced(function.__module__):
        return
    visited.add(id(function))
    yield _describe_code(function.__code__)
    yield from _describe_item(function.__defaults__ or (), visited)
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # empty: the name is assigned later
            yield from _describe_item(cell.cell_contents, visited)
    for name in _list_names(function.__code__):
        if name not in function.__globals__:
            continue
        item = function.__globals__[name]
        yield name
        if not isinstance(item, ModuleType):
            yield from _describe_item(item, visited)
        elif not _is_replaced(item.__name__):
            # The attributes are among the names; which of them belong to the module is not known.
            for attribute in _list_names(function.__code__):
                if attribute in vars(item):
                    yield attribute
                    yield from _describe_item(vars(item)[attribute], visited)


def _is_replaced(module: str | None) -> bool:
    return (module or "").partition(".")[0] in _REPLACED_PACKAGES


@compute_once
def _list_names(code: CodeType) -> list[str]:
    """Return the global names and attributes that a function and those nested in it refer to."""
    nested = (c for c in code.co_consts if isinstance(c, CodeType))
    return sorted({*code.co_names, *(name for each in nested for name in _list_names(each))})


@compute_once
def _describe_code(code: CodeType) -> str:
    """Return bytecode, constants and names of a function, without memory addresses."""
    constants = [
        _describe_code(constant)
        if isinstance(constant, CodeType)
        # The order of a set differs between processes.
        else repr(sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant)
        for constant in code.co_consts
    ]
    return f"{code.co_code.hex()} {constants} {code.co_names}"


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a function, valid as long as all that is compiled into it is the same.

    numba compares a stamp of the function's own file only. The stamp is completed at the first
    compilation, when all that the function calls is defined. An outdated index is replaced and its
    files are written over.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function for a signature, None if it has to be compiled."""
        source_stamp = self._impl.locator.get_source_stamp()
        self._cache_file._source_stamp = (source_stamp, fingerprint_kernel(self._py_func))
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a damaged pickle can raise anything
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function; without room on the disk it serves this process only."""
        with suppress(OSError):
            super().save_overload(sig, data)
            folder, source = Path(self._cache_path), Path(self._impl.locator._py_file).absolute()
            (folder / SOURCE_MARKER).write_text(str(source.parent))
            remove_outdated_kernels(folder, source)
            _remove_abandoned_once(folder.parent)


def remove_outdated_kernels(folder: Path, source: Path) -> None:
    """Remove compiled functions of a source file that are older than the file.

    The line of a function is part of the file names, so moved and deleted functions leave files.
    """
    changed_at = source.stat().st_mtime
    for path in folder.glob(f"{source.stem}.*.nb[ci]"):
        if path.stat().st_mtime < changed_at:
            path.unlink(missing_ok=True)


def remove_abandoned_folders(root: Path) -> None:
    """Remove the folders of compiled kernels whose source folder does not exist any more."""
    for marker in root.glob(f"*/{SOURCE_MARKER}"):
        if not Path(marker.read_text()).is_dir():
            shutil.rmtree(marker.parent, ignore_errors=True)


_remove_abandoned_once = compute_once(remove_abandoned_folders)
