"""Optional baseline methods on the same recordings (`pip install shaketwin[rivals,laws]`)."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tests.studies.blind.adapter import load_case
from tests.studies.blind.baseline_terms import RegressionProblem, make_regression_problem

Json = dict[str, Any]
# baseline: required package
REQUIRED_PACKAGES = {"pysindy": "pysindy", "pyoperon": "pyoperon", "blackbox": "sklearn"}
MISSING_MESSAGE = (
    "baselines skipped, packages not installed: {}; pip install 'shaketwin[rivals,laws]'"
)


def run_sindy(case_dir: Path) -> Json:
    """Run PySINDy on the recording of a case; return the verdict."""
    from tests.studies.blind.baseline_sindy import select_terms

    return select_terms(_load_problem(case_dir))


def run_blackbox(case_dir: Path) -> Json:
    """Run boosted trees on the recording of a case; return a verdict with their error."""
    from tests.studies.blind.baseline_blackbox import fit_boosted_trees

    return fit_boosted_trees(_load_problem(case_dir))


def run_symbolic_regression(case_dir: Path) -> Json:
    """Run pyoperon on the recording of a case; return a verdict with its error."""
    from tests.studies.blind.baseline_symbolic import fit_expressions

    return fit_expressions(_load_problem(case_dir))


def find_baselines() -> dict[str, Callable[[Path], Json]]:
    """Return the baselines by name whose package is installed."""
    baselines = {
        "pysindy": run_sindy, "pyoperon": run_symbolic_regression, "blackbox": run_blackbox
    }  # fmt: skip
    return {
        name: baseline for name, baseline in baselines.items() if find_spec(REQUIRED_PACKAGES[name])
    }


def describe_missing() -> str:
    """Return a message about baselines that are not installed; empty if all are."""
    missing_packages = [package for package in REQUIRED_PACKAGES.values() if not find_spec(package)]
    return MISSING_MESSAGE.format(", ".join(missing_packages)) if missing_packages else ""


def _load_problem(case_dir: Path) -> RegressionProblem:
    logs, _, model = load_case(case_dir)
    return make_regression_problem(logs[0], model)
