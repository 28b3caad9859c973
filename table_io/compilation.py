"""Numba compilation of kernels, and a cache on disk that knows them by all that is in them."""

import hashlib
import inspect
import pickle
import platform
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from enum import Enum
from functools import cache as compute_once
from functools import wraps
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

import llvmlite
import numba
from numba import njit, types
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.extending import overload, register_jitable

F = TypeVar("F", bound=Callable[..., Any])

MAX_UNUSED_DAYS = 30.0  # of a compiled kernel, which is removed then
# Their functions are replaced by numba's own, which numba's version in the cache stands for.
_REPLACED_PACKAGES = frozenset({"builtins", "cmath", "math", "numba", "numpy"})


def jit_kernel(*signatures: Any) -> Callable[[F], F]:
    """Compile a kernel that Python calls with numba.njit, keeping its type annotations.

    What was compiled is kept on disk and loaded wherever the same code is compiled again, in any
    process and copy of the sources, see `_KernelCache`.
    """

    def decorate(function: F) -> F:
        if function.__code__.co_filename == "<string>":
            # numba's linker tells functions apart by name, and written ones share theirs.
            function.__qualname__ += f"_{fingerprint_kernel(function)[:16]}"
        kernel: Any = njit(nogil=True)(function)
        if not hasattr(kernel, "py_func"):
            return function  # NUMBA_DISABLE_JIT
        kernel._cache = _KernelCache(function)
        for each in signatures:
            for signature in each if isinstance(each, list) else [each]:
                kernel.compile(signature)
        if signatures:
            kernel.disable_compile()
        return cast("F", kernel)

    return decorate


def jit_untyped_kernel(function: Callable[..., Any]) -> Any:
    """Compile a kernel without type annotations, see `jit_kernel`."""
    return jit_kernel()(function)


# Marks a helper of kernels that Python never calls.
inline_jit = njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def jit_helper(*, inlined: bool = False) -> Callable[[F], F]:
    """Mark a helper for compilation into the kernels that call it; Python runs it uncompiled.

    It has no compiled entry point from Python, which would double its compilation time.
    """
    options = {"nogil": True, "forceinline": inlined, "no_cfunc_wrapper": True}

    def decorate(function: F) -> F:
        function.helper_options = options  # type: ignore[attr-defined]
        return cast("F", register_jitable(**options)(function))

    return decorate


def jit_untyped_helper(function: Callable[..., Any]) -> Any:
    """Mark a helper without type annotations, see `jit_helper`."""
    return jit_helper()(function)


def jit_helper_unless_none(argument: str, otherwise: Callable[..., Any]) -> Callable[[F], F]:
    """As an inlined `jit_helper`, but the function is `otherwise` where `argument` is None.

    The type of the argument decides at compilation, so the case that is absent costs nothing.
    """

    def decorate(function: F) -> F:
        position = list(inspect.signature(function).parameters).index(argument)

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
        yield repr(list(getattr(item, "__members__", {}).items()))
        yield from _describe_item(tuple(getattr(item, "_field_defaults", {}).values()), visited)
    elif hasattr(item, "tobytes"):  # arrays and numbers of numpy
        yield f"{item.dtype} {item.shape} {item.tobytes().hex()}"
    else:
        yield repr(getattr(item, "targetoptions", getattr(item, "helper_options", None)))
        # What is compiled: of dispatchers their function, of choices by type all that are chosen.
        for function in getattr(item, "implementations", (getattr(item, "py_func", item),)):
            if isinstance(function, FunctionType):
                yield from _describe_function(function, visited)
            elif _is_replaced(getattr(function, "__module__", None)):
                yield f"{function.__module__} {function.__qualname__}"
            else:  # nothing is known of it: what was compiled serves this process only
                yield f"{type(function).__qualname__} {id(function)}"


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


class _KernelCache:
    """The signatures of a kernel that were compiled, on disk: a file each, for numba's dispatcher.

    The name of a file is a digest of all that decides what is in it: code and constants of the
    kernel and of what it calls, signature, processor, versions, and this module. So it is found
    from every copy of the sources, never outdated and never written with other content. A file that
    cannot be read or written costs only time.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self.cache_path = numba.config.CACHE_DIR

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the compiled function for a signature, None if it has to be compiled."""
        rtsys.initialize(target_context)  # all else is for compilation, which loads it
        path = self._locate(signature, target_context.codegen())
        try:
            content = path.read_bytes()
        except OSError:
            return None
        with suppress(OSError):
            path.touch()  # still used
        digest, data = content[:32], content[32:]
        if hashlib.sha256(data).digest() != digest:
            return None
        return CompileResult._rebuild(target_context, *pickle.loads(data))

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a compiled function, unless it holds addresses of this process."""
        if compiled.library.has_dynamic_globals:
            return
        path = self._locate(signature, compiled.codegen)
        data = dumps(compiled._reduce())
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
                file.write(hashlib.sha256(data).digest() + data)
            Path(file.name).replace(path)
            _remove_unused_once(path.parent)

    def _locate(self, signature: Any, codegen: Any) -> Path:
        parts = (
            fingerprint_kernel(self._function),
            repr(signature),
            *_list_classes(signature),
            repr(codegen.magic_tuple()),
            _identify_compiler(),
        )
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
        return Path(self.cache_path) / f"{self._function.__name__}-{key[:40]}.kernel"


def _list_classes(signature: Any) -> Iterator[str]:
    """Yield where the classes of tuples with names lie: what was compiled is loaded with them."""
    for item in getattr(signature, "args", signature):
        if isinstance(item, types.BaseNamedTuple):
            yield f"{item.instance_class.__module__}.{item.instance_class.__qualname__}"
        yield from _list_classes(getattr(item, "types", ()))


@compute_once
def _identify_compiler() -> str:
    """Return versions of what compiles, and the code here that decides how."""
    versions = numba.__version__, llvmlite.__version__, platform.python_version()
    return f"{versions} {Path(__file__).read_text()}"


def remove_unused_kernels(folder: Path) -> None:
    """Remove what was last used `MAX_UNUSED_DAYS` before the newest in a folder of kernels."""
    with suppress(OSError):  # another process removes too
        used = {path: path.stat().st_mtime for path in folder.rglob("*")}
        oldest = max(used.values(), default=0.0) - MAX_UNUSED_DAYS * 86400.0
        for path, used_at in used.items():
            if path.is_file() and used_at < oldest:
                path.unlink(missing_ok=True)


_remove_unused_once = compute_once(remove_unused_kernels)
