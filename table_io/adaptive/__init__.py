"""Adaptive tests: policies that choose the next step from the results so far.

A policy is a pure function of the results so far. It returns the next step (a Decision), None to
continue the sweep as planned, or, when the test is over, a sentence with the result.

A policy module has `describe_policy(config, profile)`, which describes its plan, and
`run_policy(config, profile)`, a generator that receives the results one by one. Every evaluation
replays the generator from its beginning, so the results are its only state.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from table_io.adaptive import dwell, jump_refinement, resonance_tracking
from table_io.adaptive.result import Decision, MissingMeasurement, PolicyGenerator, StepResult
from table_io.config.profile import Profile

__all__ = ["Decision", "Policy", "StepResult", "describe_adaptive_test", "make_policy"]

Policy = Callable[[tuple[StepResult, ...]], Decision | str | None]
POLICY_MODULES: dict[str, Any] = {
    "dwell": dwell,
    "track": resonance_tracking,
    "refine": jump_refinement,
}


def make_policy(profile: Profile) -> Policy | None:
    """Return the policy that a profile configures; None for a plain sweep."""
    for name, module in POLICY_MODULES.items():
        config = getattr(profile, name)
        if config is not None:
            return partial(_replay_policy, module, config, profile)
    return None


def describe_adaptive_test(profile: Profile) -> str:
    """Describe the adaptive part of a test in one sentence; "" for a plain sweep."""
    for name, module in POLICY_MODULES.items():
        config = getattr(profile, name)
        if config is not None:
            return f"{name}: {module.describe_policy(config, profile)}"
    return ""


def _replay_policy(
    module: Any, config: Any, profile: Profile, results: tuple[StepResult, ...]
) -> Decision | str | None:
    """Replay the generator of a policy on the results and return its last request."""
    generator: PolicyGenerator = module.run_policy(config, profile)
    try:
        request = next(generator)
        for result in results:
            request = generator.send(result)
    except StopIteration as end:
        return str(end.value)
    except MissingMeasurement as error:
        return f"{error}; the test ends"
    return request
