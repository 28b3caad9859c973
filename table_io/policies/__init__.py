"""Tests that find their way: what follows a step is decided from what the steps so far did.

A policy is a pure function of the results so far: the next step; None where the sweep goes on as
planned; or a sentence, where the test is over: what was found.

A tool is one file with `words(card, profile)`, its plan in words, and `begin(card, profile)`, a
generator that is told the results one by one. It is run from its beginning whenever it is asked, so
nothing is remembered but the results.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from table_io.policies import dwell, refine, track
from table_io.policies.result import Decision, Result, Tool, Unmeasured
from table_io.profile import Profile

__all__ = ["Decision", "Policy", "Result", "policy_of", "words_of"]

Policy = Callable[[tuple[Result, ...]], Decision | str | None]
TOOLS: dict[str, Any] = {"dwell": dwell, "track": track, "refine": refine}


def policy_of(profile: Profile) -> Policy | None:
    """The policy that a profile asks for; None for a plain sweep, whose steps are all known."""
    for name, tool in TOOLS.items():
        card = getattr(profile, name)
        if card is not None:
            return partial(_following, tool, card, profile)
    return None


def words_of(profile: Profile) -> str:
    """What comes after the planned sweep, in words; "" where nothing does."""
    for name, tool in TOOLS.items():
        card = getattr(profile, name)
        if card is not None:
            return f"{name}: {tool.words(card, profile)}"
    return ""


def _following(
    tool: Any, card: Any, profile: Profile, results: tuple[Result, ...]
) -> Decision | str | None:
    """What a tool asks for after these results."""
    running: Tool = tool.begin(card, profile)
    try:
        move = next(running)
        for result in results:
            move = running.send(result)
    except StopIteration as end:
        return str(end.value)
    except Unmeasured as error:
        return f"{error}; the test ends"
    return move
