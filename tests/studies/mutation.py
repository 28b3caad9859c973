"""Mutation testing: how many single-line faults of a package its own tests find.

    python -m tests.studies.mutation --mutants 20 --seed 1 [--line FILE:LINE] [PACKAGE ...]

From each package of `TARGETS` so many mutants are drawn, without replacement and with a seed: a
comparison, a sign, a number, a condition or a statement of one line is changed. The tests of the
package run on each, in a copy of the repository, until the first one fails. A mutant that passes
them all has survived: either a test is missing, or the change makes no difference. A run beyond the
time limit, which is four times that of the unchanged code, counts as killed.

The same seed draws the same mutants as long as the files are the same.
"""

import argparse
import ast
import copy
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# Not used here but inherited by each child, which saves their import.
import matplotlib  # noqa: F401
import numba
import pydantic  # noqa: F401
import pytest
import scipy.optimize
import scipy.signal  # noqa: F401

REPOSITORY = Path(__file__).parents[2]
TIME_LIMIT_FACTOR, MIN_TIME_LIMIT_S = 4.0, 60.0


@dataclass(frozen=True)
class Target:
    """Files in which faults are planted, and the tests that have to find them."""

    files: tuple[str, ...]
    tests: tuple[str, ...]
    uncompiled: bool = False


TARGETS = {
    "protection": Target(
        ("table_io/safety/protection/*.py",),
        (
            "tests/table_io/safety/test_protection*.py",
            "tests/table_io/safety/test_sample_checks.py",
        ),
    ),
    "session": Target(
        tuple(
            f"table_io/acquisition/{name}.py" for name in ("session", "output_queue", "event_log")
        ),
        tuple(
            f"tests/table_io/acquisition/test_{name}.py"
            for name in ("output_queue", "session", "session_commands", "resume")
        ),
    ),
    "limits": Target(
        ("table_io/safety/preflight.py",), ("tests/table_io/safety/test_preflight.py",)
    ),
    "tracking": Target(
        tuple(
            f"table_io/control/{name}.py" for name in ("order_tracking", "amplitude_control", "frf")
        ),
        ("tests/table_io/control",),
    ),
    "calibration": Target(
        ("table_io/config/calibration*.py", "twin/cli/calibrate.py"),
        ("tests/table_io/config/test_calibration*.py", "tests/cli/test_calibrate.py"),
    ),
    "drive": Target(
        ("table_io/excitation/*.py",),
        ("tests/table_io/excitation", "tests/table_io/config/test_stepped_sine_levels.py"),
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
        ("tests/transport",),
    ),
    "recorder": Target(
        (
            "twin/live/recorder.py",
            *(
                f"twin/recording/{name}.py"
                for name in ("append_only_file", "mcap_log", "mcap_records", "merge", "recovery")
            ),
        ),
        ("tests/live/test_recorder.py", "tests/live/test_disk_full.py", "tests/recording"),
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
            waiting += [child for child in children if isinstance(child, ast.AST)]


def run_tests(target: Target, copied: Path, limit_s: float) -> bool:
    """Run the tests of a package in the copy; return whether they all pass.

    A child process runs them that has inherited the libraries, but nothing of the repository.
    """
    child = os.fork()
    if child == 0:
        os.setsid()
        try:
            os._exit(run_tests_here(target, copied))
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    deadline_s = time.monotonic() + limit_s
    while time.monotonic() < deadline_s:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status == 0
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def run_tests_here(target: Target, copied: Path) -> int:
    """Run the tests of a package in this process; return pytest's exit code."""
    tests = [
        str(path.relative_to(copied)) for part in target.tests for path in sorted(copied.glob(part))
    ]
    for name in list(sys.modules):
        if name.partition(".")[0] == "tests":
            del sys.modules[name]
    os.chdir(copied)
    sys.path[:] = [str(copied), *(path for path in sys.path if path not in ("", str(REPOSITORY)))]
    os.environ["PYTHONPATH"] = str(copied)  # for the commands that tests start
    if target.uncompiled:
        numba.config.DISABLE_JIT = 1
    with open(os.devnull, "w") as silence:
        os.dup2(silence.fileno(), 1)
        os.dup2(silence.fileno(), 2)
        options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--benchmark-disable"]
        return int(pytest.main(["-o", "addopts=-m 'not slow'", *options, *tests]))


def study_package(name: str, count: int, seed: int, copied: Path, only: str) -> tuple[int, int]:
    """Print the fate of the mutants drawn from one package; return (killed, drawn)."""
    target = TARGETS[name]
    files = [path for part in target.files for path in sorted(copied.glob(part))]
    mutants = [
        mutant
        for path in files
        for mutant in list_mutants(str(path.relative_to(copied)), path.read_text())
        if not only or f"{mutant.file}:{mutant.line}" == only
    ]
    begin = time.monotonic()
    if not run_tests(target, copied, 3600.0):
        raise SystemExit(f"{name}: the tests fail on the unchanged code")
    limit_s = max(MIN_TIME_LIMIT_S, TIME_LIMIT_FACTOR * (time.monotonic() - begin))
    print(f"{name}: {len(mutants)} mutants possible, tests take {limit_s / 4:.0f} s", flush=True)
    chance = random.Random(f"{name} {seed}")
    drawn = chance.sample(mutants, min(count, len(mutants)))
    killed = 0
    for mutant in drawn:
        path = copied / mutant.file
        original = path.read_text()
        path.write_text(mutant.text)
        try:
            survives = run_tests(target, copied, limit_s)
        finally:
            path.write_text(original)
        killed += not survives
        print(f"{name} {'SURVIVED' if survives else 'killed  '} {mutant}", flush=True)
    print(f"{name}: {killed} of {len(drawn)} killed", flush=True)
    return killed, len(drawn)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help=", ".join(TARGETS))
    parser.add_argument("--mutants", type=int, default=20, help="of each package")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--line", default="", help="FILE:LINE: mutants of this line only")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder) / "main"
        ignored = shutil.ignore_patterns(".venv", ".git", "__pycache__", "runs", ".*_cache")
        shutil.copytree(REPOSITORY, copied, ignore=ignored)
        totals = [
            study_package(name, asked.mutants, asked.seed, copied, asked.line)
            for name in asked.packages or TARGETS
        ]
    killed, drawn = (sum(column) for column in zip(*totals, strict=True))
    print(f"all: {killed} of {drawn} killed ({killed / drawn:.0%})")


if __name__ == "__main__":
    main()
