"""`shaketwin keys router`: a zenoh router between rig and people that lets nobody cheat."""

import json
from datetime import UTC, datetime
from pathlib import Path

from table_io.card import BadInput
from twin.stream.access import ROUTER, router_access
from twin.stream.endpoint import PUBLIC, check, merged, settings
from twin.stream.keys import Keys, read_people


def print_router(folder: Path, name: str, listen: str, rig: str) -> None:
    """Prints what zenohd reads, for one started in the router's own folder, FOLDER/people/NAME.

    It holds today's access list; print it anew when that changes.
    """
    people = read_people(folder)
    if people.get(name) != ROUTER:
        routers = [one for one, role in people.items() if role == ROUTER]
        raise BadInput(
            f"{name}: no router in {folder}; known: {', '.join(routers) or 'none'}; add one by "
            f"`shaketwin keys add {folder} NAME --role router --host HOST`"
        )
    check(rig, listen, keyed=True)
    here = Keys(Path(), name, datetime.now(UTC), None)
    own = merged(PUBLIC, merged(here.tls(), router_access(rig, people)))
    print(json.dumps(merged(settings("router", "listen", listen, 0), own), indent=1))
