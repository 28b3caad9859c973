"""Mutation testing: how many single-line faults of a package its own tests find.

    python -m tests.studies.mutation --mutants 20 --seed 1 [--line FILE:LINE] [PACKAGE ...]

From each package of `TARGETS` so many mutants are drawn, without replacement and with a seed: a
comparison, a sign, a number, a condition or a statement of one line is changed. The tests of the
package run on each until the first one fails. A mutant that passes them all has survived: either a
test is missing, or the change makes no difference. A run beyond the time limit counts as killed.

No file is changed: a process that has collected the tests is copied for each mutant, and functions
and constants of the package are replaced there. Kernels are compiled anew with their fault, or run
uncompiled; faults in the body of a class, or in what tests start as a command, are not drawn or not
seen.

The same seed draws the same mutants as long as the files are the same.
"""

import argparse
import ast
import copy
import importlib
import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from _pytest.main import pytest_runtestloop as run_test_loop
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

REPOSITORY = Path(__file__).parents[2]
TIME_LIMIT_FACTOR, MIN_TIME_LIMIT_S = 4.0, 60.0


@dataclass(frozen=True)
class Target:
    """Files in which faults are planted, and the tests that have to find them."""

    files: tuple[str, ...]
    tests: tuple[str, ...]
    uncompiled: bool = False


TRACKING = ("harmonics", "control/table_response", "control/amplitude_control")
TARGETS = {
    "consistency": Target(
        ("table_io/safety/consistency.py",),
        ("tests/table_io/safety/test_consistency.py",),
    ),
    "protection": Target(
        tuple(
            f"table_io/safety/{name}.py"
            for name in ("protection", "sample_checks", "cycle_checks", "findings")
        ),
        tuple(
            f"tests/table_io/safety/test_{name}.py"
            for name in ("consistency", "sample_checks", "cycle_checks", "protection")
        ),
    ),
    "session": Target(
        tuple(f"table_io/acquisition/{name}.py" for name in ("session", "output_queue")),
        tuple(
            f"tests/table_io/acquisition/test_{name}.py"
            for name in ("output_queue", "session_commands", "session")
        ),
    ),
    "limits": Target(
        ("table_io/safety/preflight.py",), ("tests/table_io/safety/test_preflight.py",)
    ),
    "checks": Target(
        ("table_io/safety/loop_check*.py", "table_io/safety/wiring_check.py"),
        tuple(
            f"tests/table_io/safety/test_{name}.py"
            for name in ("loop_check", "wiring_check", "tap_test", "digital_inputs")
        ),
    ),
    "config": Target(
        ("table_io/config/*.py", "table_io/config/excitation/*.py"),
        ("tests/table_io/config/test_*.py", "tests/table_io/excitation/test_*.py"),
    ),
    "sim": Target(
        ("table_io/sim/*.py",),
        tuple(
            f"tests/table_io/sim/test_{name}.py"
            for name in ("*plant", "*_table", "laboratory", "faults", "filters", "ground_truth")
        ),
    ),
    "backends": Target(
        ("table_io/backends/*.py", "table_io/backends/udp/*.py", "table_io/backends/machine/*.py"),
        ("tests/table_io/backends/test_*.py",),
    ),
    "tracking": Target(
        tuple(f"table_io/{name}.py" for name in TRACKING),
        tuple(f"tests/table_io/{Path(name).parent}/test_{Path(name).name}.py" for name in TRACKING),
    ),
    "calibration": Target(
        ("table_io/config/calibration*.py", "twin/rig/calibrate.py"),
        ("tests/table_io/config/test_calibration*.py", "tests/cli/test_calibrate.py"),
    ),
    "drive": Target(
        ("table_io/excitation/*.py",),
        ("tests/table_io/excitation/test_*.py",),
    ),
    "kernels": Target(
        (
            "twin/model/*_kernel.py",
            "twin/model/event_location.py",
            "twin/model/contact_regime.py",
        ),
        tuple(
            f"tests/model/test_{name}.py"
            for name in ("closed_form", "event_integrator", "stepped_sine", "energy", "random")
        ),
        uncompiled=True,
    ),
    "pipeline": Target(
        ("twin/compare/*.py",),
        tuple(
            f"tests/compare/test_{name}.py"
            for name in ("pipeline", "twins", "cycles", "curves", "sensors", "extra_channels")
        ),
    ),
    "wire": Target(
        tuple(
            f"twin/transport/{name}.py"
            for name in ("codec", "history_cache", "reliable_subscriber", "requests")
        ),
        tuple(f"tests/transport/test_{name}.py" for name in ("codec", "codec_blocks", "fragments")),
    ),
    "recorder": Target(
        (
            "twin/live/recorder.py",
            *(f"twin/recording/{name}.py" for name in ("mcap_log", "merge", "recovery")),
        ),
        ("tests/live/test_recorder.py", "tests/recording/test_*.py"),
    ),
}

OTHER_COMPARISONS = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}
OTHER_OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
OTHER_NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}
OTHER_NAMES |= {"any": "all", "all": "any", "sin": "cos", "cos": "sin", "ceil": "floor"}


@dataclass(frozen=True)
class Mutant:
    """One changed line of a file; `text` is the whole file with it."""

    file: str
    line: int
    before: str
    after: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.before}  ->  {self.after}"


def change_node(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the faults that may be planted at a node of the syntax tree."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, bool):
            yield ast.Constant(not node.value)
        elif isinstance(node.value, int | float):
            yield ast.Constant(node.value + 1)
            if node.value:
                yield ast.Constant(node.value * 0.5 if isinstance(node.value, float) else 0)
    elif isinstance(node, ast.Call):
        yield from change_call(node)
    elif isinstance(node, ast.IfExp):
        yield from (node.body, node.orelse)
    elif isinstance(node, ast.Continue):
        yield ast.Break()
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield ast.Pass()  # a statement left out
    else:
        yield from change_operator(node)


def change_operator(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node with another comparison, arithmetic or logical operator."""
    if isinstance(node, ast.Compare):
        for position, operator in enumerate(node.ops):
            for other in OTHER_COMPARISONS[type(operator)]:
                compared = copy.deepcopy(node)
                compared.ops[position] = other()
                yield compared
    elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in OTHER_OPERATORS:
        changed = copy.deepcopy(node)
        changed.op = OTHER_OPERATORS[type(node.op)]()
        yield changed
    elif isinstance(node, ast.BoolOp):
        joined = copy.deepcopy(node)
        joined.op = ast.And() if isinstance(node.op, ast.Or) else ast.Or()
        yield joined
    elif isinstance(node, ast.UnaryOp):
        yield node.operand


def change_call(node: ast.Call) -> Iterator[ast.AST]:
    """Yield a call of the opposite function, or what an absolute value is taken of."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name in OTHER_NAMES:
        changed = copy.deepcopy(node)
        if isinstance(changed.func, ast.Attribute):
            changed.func.attr = OTHER_NAMES[name]
        elif isinstance(changed.func, ast.Name):
            changed.func.id = OTHER_NAMES[name]
        yield changed
    elif name in ("abs", "fabs", "hypot", "sqrt") and node.args:
        yield node.args[0]


def list_mutants(file: str, text: str) -> list[Mutant]:
    """Return every mutant of a file that changes one line."""
    lines = text.splitlines(keepends=True)
    encoded = [line.encode() for line in lines]
    mutants: dict[str, Mutant] = {}
    for node in walk_code(ast.parse(text)):
        line = getattr(node, "lineno", 0)
        if not line or node.end_lineno != line:  # type: ignore[attr-defined]
            continue
        start, end = node.col_offset, node.end_col_offset  # type: ignore[attr-defined]
        for changed in change_node(node):
            is_expression = isinstance(changed, ast.expr)
            source = f"({ast.unparse(changed)})" if is_expression else ast.unparse(changed)
            if isinstance(changed, ast.Constant):
                source = ast.unparse(changed)
            row = (encoded[line - 1][:start] + source.encode() + encoded[line - 1][end:]).decode()
            whole = "".join([*lines[: line - 1], row, *lines[line:]])
            mutants.setdefault(
                whole, Mutant(file, line, lines[line - 1].strip(), row.strip(), whole)
            )
    return list(mutants.values())


def walk_code(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes of what is executed: no annotations, no texts, no imports."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(
            node, ast.JoinedStr | ast.arguments | ast.Import | ast.ImportFrom | ast.Raise
        ):
            continue  # messages are free to change
        yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            children = value if isinstance(value, list) else [value]
            if isinstance(node, ast.ClassDef):
                children = [child for child in children if isinstance(child, ast.FunctionDef)]
            waiting += [child for child in children if isinstance(child, ast.AST)]


def patch_module(module: ModuleType, text: str) -> None:
    """Replace code and constants of an imported module by those of another source text."""
    new = ModuleType(module.__name__)
    new.__file__ = module.__file__
    exec(compile(text, str(module.__file__), "exec"), new.__dict__)
    for name, value in vars(new).items():
        old = vars(module).get(name)
        if isinstance(value, bool | int | float | str | tuple | frozenset | dict):
            with np.printoptions(threshold=sys.maxsize):
                is_same = repr(value) == repr(old)  # they may hold arrays
            if not is_same and not name.startswith("__"):
                rebind_constant(name, old, value)
        elif getattr(value, "__module__", "") == module.__name__:
            patch_object(old, value)


def try_patch(module: ModuleType, text: str) -> int:
    """Replace a module by another text as `patch_module` does; return 0."""
    patch_module(module, text)
    return 0


def rebind_constant(name: str, old: Any, new: Any) -> None:
    """Replace a constant in every module that has imported it."""
    for module in list(sys.modules.values()):
        is_ours = getattr(module, "__name__", "").startswith(("table_io", "twin"))
        if is_ours and vars(module).get(name) is old:
            vars(module)[name] = new


def patch_object(old: Any, new: Any) -> None:
    """Replace the code of a function, or of the methods of a class."""
    if isinstance(old, type):
        for name, value in vars(new).items():
            if name in vars(old):
                patch_object(vars(old)[name], value)
    elif isinstance(old, property):
        patch_object(old.fget, new.fget)
    elif isinstance(old, cached_property):
        patch_object(old.func, new.func)
    elif isinstance(old, Dispatcher):
        assert not old.overloads, f"{old.py_func.__name__} is compiled before the fault is planted"
        patch_object(old.py_func, new.py_func)
        old._cache = NullCache()  # which holds the code without the fault
    elif isinstance(old, staticmethod | classmethod):
        patch_object(old.__func__, new.__func__)
    elif isinstance(old, FunctionType) and isinstance(new, FunctionType):
        if "__wrapped__" in vars(old):
            patch_object(vars(old)["__wrapped__"], vars(new)["__wrapped__"])
        elif old.__code__.co_freevars == new.__code__.co_freevars:
            old.__code__, old.__defaults__ = new.__code__, new.__defaults__
            old.__kwdefaults__ = new.__kwdefaults__


def run_in_child(action: Callable[[], int], limit_s: float) -> int:
    """Return what `action` returns in a copy of this process, -1 beyond the limit."""
    child = os.fork()
    if child == 0:
        os.setsid()
        try:
            os._exit(action())
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    deadline_s = time.monotonic() + limit_s
    while time.monotonic() < deadline_s:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1


@dataclass
class Study:
    """Plug-in of pytest that, instead of the collected tests, runs all of them for each mutant."""

    name: str
    files: list[Path]
    count: int
    seed: int
    only: str

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection(self) -> None:
        """Let hypothesis stop at the first example that fails."""
        from hypothesis import Phase, settings  # later than the plug-ins of pytest

        settings.register_profile("mutation", phases=[Phase.explicit, Phase.generate])
        settings.load_profile("mutation")

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Print the fate of the mutants drawn from the package."""
        begin_s = time.monotonic()
        if run_in_child(lambda: run_tests(session), 3600.0):
            raise SystemExit(f"{self.name}: the tests fail on the unchanged code")
        tests_s = time.monotonic() - begin_s
        limit_s = max(MIN_TIME_LIMIT_S, TIME_LIMIT_FACTOR * tests_s)
        modules = {str(file.relative_to(REPOSITORY)): import_file(file) for file in self.files}
        for file, module in modules.items():
            text = Path(str(module.__file__)).read_text()
            if run_in_child(partial(try_patch, module, text), limit_s):
                raise SystemExit(f"{self.name}: {file} cannot be replaced")
        mutants = [
            mutant
            for file, module in modules.items()
            for mutant in list_mutants(file, Path(str(module.__file__)).read_text())
            if not self.only or f"{mutant.file}:{mutant.line}" == self.only
        ]
        print(f"{self.name}: {len(mutants)} mutants possible, tests take {tests_s:.0f} s")
        chance = random.Random(f"{self.name} {self.seed}")
        drawn = chance.sample(mutants, min(self.count, len(mutants)))
        killed = 0
        for mutant in drawn:

            def run_mutant(mutant: Mutant = mutant) -> int:
                patch_module(modules[mutant.file], mutant.text)
                return run_tests(session)

            survives = run_in_child(run_mutant, limit_s) == 0
            killed += not survives
            verdict = "SURVIVED" if survives else "killed  "
            print(f"{self.name} {verdict} {mutant}", flush=True)
        print(f"{self.name}: {killed} of {len(drawn)} killed", flush=True)
        return True


def run_tests(session: pytest.Session) -> int:
    """Run the collected tests silently until one fails; return 0 if none does."""
    with open(os.devnull, "w") as silence:
        os.dup2(silence.fileno(), 1)
        os.dup2(silence.fileno(), 2)
        try:
            run_test_loop(session)
        except session.Failed:
            return 1
        return int(session.testsfailed > 0)


def import_file(file: Path) -> ModuleType:
    """Import the module of a file of the repository."""
    parts = file.relative_to(REPOSITORY).with_suffix("").parts
    return importlib.import_module(".".join(part for part in parts if part != "__init__"))


def study_package(name: str, count: int, seed: int, only: str) -> int:
    """Study the mutants drawn from one package; return pytest's exit code."""
    target = TARGETS[name]
    if target.uncompiled:
        numba.config.DISABLE_JIT = 1
    tests, files = (
        [file for part in parts for file in sorted(REPOSITORY.glob(part))]
        for parts in (target.tests, target.files)
    )
    assert files, f"{name}: no file is named {' or '.join(target.files)}"
    assert tests, f"{name}: no file is named {' or '.join(target.tests)}"
    options = ["-x", "-q", "-s", "-n", "0", "-p", "no:cacheprovider", "--benchmark-disable"]
    options += ["-o", "addopts=-m 'not slow'"]
    study = Study(name, files, count, seed, only)
    return int(pytest.main([*options, *map(str, tests)], plugins=[study]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help=", ".join(TARGETS))
    parser.add_argument("--mutants", type=int, default=20, help="of each package")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--line", default="", help="FILE:LINE: mutants of this line only")
    asked = parser.parse_args()
    for name in asked.packages or TARGETS:
        study = partial(study_package, name, asked.mutants, asked.seed, asked.line)
        if run_in_child(study, float("inf")):
            print(f"{name}: not studied")


if __name__ == "__main__":
    main()
