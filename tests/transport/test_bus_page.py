"""The page of the public interface: its example runs as it stands, its table has every topic."""

import os
import re
import select
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Block
from tests.builders.ports import free_endpoint
from twin.security.access_control import build_open_access
from twin.transport import codec
from twin.transport.endpoint import MEAS_TOPIC, PUBLIC_HUB_SETTINGS, key_expression, merge_settings
from twin.transport.zenoh_link import open_hub

PAGE = (Path(codec.__file__).parent / "BUS.md").read_text()
MAX_TURNS = 4000  # turns of the hub, 5 ms each


@pytest.mark.parametrize("topic", codec.TOPIC_TYPES)
def test_every_topic_and_its_message_stand_in_the_table(topic: str) -> None:
    rows = [line for line in PAGE.splitlines() if f"`{key_expression('x', topic)[12:]}`" in line]
    assert len(rows) == 1
    assert f"`{codec.MESSAGE_NAMES[codec.TOPIC_TYPES[topic]]}`" in rows[0]


def test_the_example_runs_as_it_stands() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    endpoint = free_endpoint()
    link = open_hub(
        "shaker", endpoint, merge_settings(PUBLIC_HUB_SETTINGS, build_open_access("shaker"))
    )
    link.declare((MEAS_TOPIC,))
    questions = link.declare_requests("config/schema")
    command = [sys.executable, "-u", "-c", example, endpoint, "shaker"]
    listener = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert listener.stdout is not None
    steps = np.zeros(20, dtype=np.int64)
    os.set_blocking(listener.stdout.fileno(), False)
    output = ""
    try:
        for number in range(MAX_TURNS):
            values = np.full((1, 20), float(number))
            block = Block(
                "meas", 20 * number, 2000.0, ("mass_disp_m",), values, steps, steps, steps
            )
            link.publish(MEAS_TOPIC, codec.encode_item(block, "r"))
            if (question := questions.poll()) is not None:
                question.reply(codec.message_schema(Block)[1])
            if select.select([listener.stdout], [], [], 0.005)[0]:
                output += os.read(listener.stdout.fileno(), 65536).decode()
            if output.count("\n") > 3:
                break
    finally:
        listener.kill()
        listener.wait()
        listener.stdout.close()
        link.close()
    lines = output.splitlines()[:3]
    assert len(lines) == 3, output
    for line in lines:
        match = re.fullmatch(r"([\d.]+) \{'(\w+)': ([\d.]+)\}", line)
        assert match is not None, line
        second, name, value = match.groups()
        assert name == "mass_disp_m"
        assert float(value) == pytest.approx(100 * float(second))
