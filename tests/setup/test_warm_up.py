"""What the warm-up leaves to compile: nothing, and it says nothing."""

import subprocess
import sys
from pathlib import Path

from tests.cli.test_cli import SHORT

# In a process of its own: here the tests before have compiled whatever they used. numba counts a
# kernel's entries from Python as its signatures, so those that a session adds were not warm.
COUNT = """
import sys
from dataclasses import replace
from numba.core.dispatcher import Dispatcher
from pathlib import Path
from table_io.sim.simulated_table import SimulatedBackend
from table_io.clock import ManualClock
from table_io.acquisition.session import run_session
from twin.setup.run_config import compile_rig_kernels, read_run_config

def compiled():
    return {(name, key): len(kernel.signatures) for name, module in list(sys.modules.items())
            if name.startswith("table_io") for key, kernel in vars(module).items()
            if isinstance(kernel, Dispatcher) and kernel.signatures}

config = read_run_config(Path(sys.argv[1]))
compile_rig_kernels(config)
before = compiled()
clock = ManualClock()
acquisition = config.profile.acquisition
backend = SimulatedBackend(config.rig, config.profile.specimen, acquisition.rate_hz, clock)
start = config.make_start_factory("r", "table")
for item in run_session(config.session_setup, backend, clock, start, lambda: None):
    pass
watched = any("check_samples" in key for key in before)
print(item.verdict, watched, compiled() == before)
"""


def test_a_run_compiles_nothing_after_the_warm_up_which_says_nothing(tmp_path: Path) -> None:
    profile = tmp_path / "short.toml"
    profile.write_text(SHORT)
    run = subprocess.run(
        [sys.executable, "-c", COUNT, str(profile)], capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["complete", "True", "True"]
    assert run.stderr == ""
