"""`shaketwin keys router`: settings of a zenoh router that enforces the access list."""

import json
from datetime import UTC, datetime
from pathlib import Path

from table_io.errors import InputError
from twin.security.access_control import ROUTER_ROLE, build_router_access
from twin.security.credentials import Credentials, read_people
from twin.transport.endpoint import (
    PUBLIC_HUB_SETTINGS,
    check_endpoint,
    merge_settings,
    session_settings,
)


def print_router_settings(folder: Path, name: str, listen: str, rig: str) -> None:
    """Print the settings for a zenohd started in the router's folder, FOLDER/people/NAME.

    They contain the current access list: print them again when it changes.
    """
    people = read_people(folder)
    if people.get(name) != ROUTER_ROLE:
        routers = [router for router, role in people.items() if role == ROUTER_ROLE]
        raise InputError(
            f"{name}: no router in {folder}; known: {', '.join(routers) or 'none'}; add one by "
            f"`shaketwin keys add {folder} NAME --role router --host HOST`"
        )
    check_endpoint(rig, listen, has_keys=True)
    router_keys = Credentials(Path(), name, datetime.now(UTC), None)
    router_settings = merge_settings(
        PUBLIC_HUB_SETTINGS,
        merge_settings(router_keys.tls_settings(), build_router_access(rig, people)),
    )
    print(
        json.dumps(
            merge_settings(session_settings("router", "listen", listen, 0), router_settings),
            indent=1,
        )
    )
