"""A process that plays runs as fast as they go: one Spec a line in, what happens a line out.

Started by `crew.py` in a session of its own; a SIGTERM, or the death of who started it, brings the
table to rest and ends the run. It holds the campaign's lock as long as it lives.
"""

import json
import os
import signal
import sys
from pathlib import Path

from table_io.card import BadInput
from table_io.records import Point
from twin.service.campaign.parts import finish
from twin.service.runs import play_unpaced
from twin.service.spec import Spec
from twin.stream.wire import Item


def _say(**words: str | int | bool) -> None:
    print(json.dumps(words), flush=True)


def main() -> None:
    """Entry of the process."""
    asked: list[str] = []
    signal.signal(signal.SIGTERM, lambda *_: asked.append("the campaign was stopped"))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()

    def why() -> str | None:
        if os.getppid() != parent:
            return "the campaign is gone"
        return asked[0] if asked else None

    def watch(item: Item) -> None:
        if isinstance(item, Point) and os.getppid() == parent:
            _say(step=item.step)

    for line in sys.stdin:
        spec = Spec(**json.loads(line))
        folder = Path(spec.folder)
        try:
            play_unpaced(spec.bundle(), spec.run, folder / "run.mcap", why, watch)
            if os.getppid() != parent:
                return
            finish(folder)
            _say(reported=True)
        except (BadInput, OSError) as error:
            _say(failed=str(error))


if __name__ == "__main__":
    main()
