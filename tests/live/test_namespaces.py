"""Two hosts as network namespaces, where this machine lets us make some."""

import json

import pytest

from tests.live.cable_pull import BLOCKS
from tests.live.namespaces import refusal, start_isolated

WHY = refusal()


@pytest.mark.slow  # 6 s
@pytest.mark.skipif(bool(WHY), reason=f"no network namespaces here: {WHY}")
def test_a_cable_pulled_for_two_seconds_leaves_no_gap() -> None:
    process = start_isolated("tests.live.cable_pull")
    try:
        output, _ = process.communicate()
    finally:
        process.kill()
    assert process.returncode == 0, output
    assert json.loads(output.splitlines()[-1]) == {"got": list(range(BLOCKS)), "missed": 0}
