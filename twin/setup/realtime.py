"""Check that a test can run in real time: block length, limits of the system, the machine."""

import math
from pathlib import Path

from table_io.acquisition.external_control import plan_open_loop_drive
from table_io.backends import check_reachable, open_backend
from table_io.clock import RealClock
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from twin.setup.run_config import RunConfig
from twin.system.resource_limits import MIN_RUN_MEMORY_BYTES, require_memory, require_open_files

MIN_BLOCK_S, MAX_BLOCK_S = 0.002, 0.05  # protection checks once per block


def check_realtime(config: RunConfig, profile_path: Path) -> None:
    """Raise InputError if a block is too short or too long, or no machine answers.

    Also if the system allows its processes too little memory or too few open files. Shorter blocks
    cannot be processed in time; longer ones delay protection too much.
    """
    samples, rate_hz = config.profile.acquisition.block_samples, config.drive.rate_hz
    min_samples, max_samples = math.ceil(rate_hz * MIN_BLOCK_S), math.floor(rate_hz * MAX_BLOCK_S)
    if not min_samples <= samples <= max_samples:
        raise InputError(
            f"not possible in real time at {rate_hz:g} Hz",
            where=profile_path,
            key="acquisition.block_samples",
            value=samples,
            allowed=f"{min_samples} to {max_samples}",
            remedy="change it, or use --speed max",
        )
    require_open_files()
    require_memory(MIN_RUN_MEMORY_BYTES)
    # Raises now if the test cannot be played by an external controller, or by the backend.
    if config.rig.under_external_control:
        plan_open_loop_drive(config.profile, config.rig)
    else:
        open_backend(config.rig, config.profile, RealClock())
    check_reachable(config.rig)


def check_full_speed(rig: RigConfig, has_page: bool = False) -> None:
    """Raise InputError if a rig cannot run at full speed: not simulated, or with a page."""
    if has_page:
        raise InputError(
            "a test at full speed has no page",
            key="--web",
            remedy="run it in real time, or look at the recording: `shaketwin view --web LOG`",
        )
    if not rig.runs_at_any_speed:
        raise InputError(
            "this rig runs in real time only",
            where="--speed max",
            key=rig.name,
            remedy="omit --speed, or give a simulated table with --table",
        )
