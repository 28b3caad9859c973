"""Two hosts and a cable that is pulled for 2 s: the program of `test_namespaces`, enclosed.

Prints as JSON which of the numbers published on one host arrived on the other, over mTLS.
"""

import sys
import tempfile
import time
from pathlib import Path

from tests.live.namespaces import HERE, cable
from twin.rig.keys import add_person, create_keys
from twin.security.credentials import read_credentials
from twin.transport.endpoint import MEAS_TOPIC, PUBLIC_HUB_SETTINGS
from twin.transport.zenoh_link import open_hub

ENDPOINT = f"tls/{HERE}:7447"
BLOCKS, PULLED, PLUGGED = 400, 100, 300  # one each 10 ms
LISTENER = """
import json, sys
from pathlib import Path
from twin.security.credentials import read_credentials
from twin.transport.zenoh_link import open_spoke
link = open_spoke("rig", sys.argv[1], 15.0, read_credentials(Path(sys.argv[2])))
inbox = link.subscribe(("/rig/meas",), history=True, capacity=10000)
got = []
while len(got) < int(sys.argv[3]) and (one := inbox.get(15.0)) is not None:
    got.append(int.from_bytes(one[1][:4], "big"))
print(json.dumps({"got": got, "missed": inbox.missed}), flush=True)
"""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, cable() as line:
        lab = Path(folder) / "lab"
        create_keys(lab, [HERE])
        add_person(lab, "far", "record", [])
        hub = open_hub("rig", ENDPOINT, PUBLIC_HUB_SETTINGS, read_credentials(lab))
        hub.declare((MEAS_TOPIC,))
        roles = hub.declare_requests("state/role/*")

        def serve() -> None:
            if (question := roles.poll()) is not None:
                question.reply("record")
            time.sleep(0.002)

        words = [ENDPOINT, str(lab / "people" / "far"), str(BLOCKS)]
        listener = line.start_far(sys.executable, "-c", LISTENER, *words, stdout=-1)
        hub.publish(MEAS_TOPIC, (0).to_bytes(4, "big"))
        assert listener.stdout is not None
        while not hub.subscriber_progress.positions and listener.poll() is None:
            serve()
        for number in range(1, BLOCKS):
            if number == PULLED:
                line.pull()
            elif number == PLUGGED:
                line.plug()
            hub.publish(MEAS_TOPIC, number.to_bytes(4, "big") + bytes(1700))
            end = time.monotonic() + 0.01
            while time.monotonic() < end:
                serve()
        while listener.poll() is None:
            serve()
        print(listener.stdout.read().splitlines()[-1], flush=True)
        hub.close()


if __name__ == "__main__":
    main()
