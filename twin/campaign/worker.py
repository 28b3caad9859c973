"""Worker process that plays runs at maximum speed; JSON lines: `ProcessConfig` in, events out.

`players.py` starts it in its own session. SIGTERM or the death of the parent process brings the
table to rest and ends the run. It holds the campaign's lock as long as it lives.
"""

import json
import os
import signal
import sys
from pathlib import Path

from table_io.errors import InputError
from table_io.records import PrcPoint
from twin.campaign.state import write_summary_and_report
from twin.live.process_config import ProcessConfig
from twin.setup.unpaced import play_unpaced
from twin.transport.codec import Item


def _send(**message: str | int | bool) -> None:
    """Print a message; without a parent that reads it, this and all later ones go nowhere."""
    try:
        print(json.dumps(message), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def run_worker() -> None:
    """Read process configs from standard input and play each run; entry point of the process."""
    stop_reasons: list[str] = []
    signal.signal(signal.SIGTERM, lambda *_: stop_reasons.append("the campaign was stopped"))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()

    def stop_reason() -> str | None:
        if os.getppid() != parent:
            return "the campaign process has ended"
        return stop_reasons[0] if stop_reasons else None

    def report_step(item: Item) -> None:
        if isinstance(item, PrcPoint) and os.getppid() == parent:
            _send(step=item.step)

    for line in sys.stdin:
        config = ProcessConfig(**json.loads(line))
        folder = Path(config.folder)
        try:
            play_unpaced(
                config.make_run_config(), config.run, folder / "run.mcap", stop_reason, report_step
            )
            if os.getppid() != parent:
                return
            write_summary_and_report(folder)
            _send(reported=True)
        except (InputError, OSError) as error:
            _send(failed=str(error))


if __name__ == "__main__":
    run_worker()
