"""Role-based access control of the gateway, as zenoh rules; everything not allowed is denied.

A rule names messages from a client ("ingress") or to it ("egress") and their keys. All rules allow:
a denying rule could be evaded with a wider key such as `put("**")`.

| role    | rights                                                                        |
|---------|-------------------------------------------------------------------------------|
| observe | subscribe to streams and events, query state, history and configuration,      |
|         | list components, declare alive/observer.<own name>.<anything>                 |
| record  | the same; a recorder needs no more                                            |
| twin    | the same, and publish a twin's results to the gateway alone (offer/**)        |
| command | the same, and commands are executed                                           |
| router  | the same in the name of the clients behind it, which it must authenticate     |

Every listed person may query cmd/<order>/<own name>, so that the gateway can refuse with a reason;
it checks the role itself before it executes. The last part of a command's key is therefore the
authenticated sender. A valid certificate that is not on the list may query state/role/none and
nothing else, which shows that the rig exists and refuses. The web page on the rig's computer
connects with the rig's certificate and, like a router, forwards commands of those who log in there.
"""

import getpass
import re
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

ZenohSettings = dict[str, Any]  # nested, as zenoh reads them from JSON

ROUTER_ROLE = "router"
ROLES = ("observe", "record", "twin", "command", ROUTER_ROLE)
NO_ROLE = "none"  # of a name that is not on the access list
RIG_NAME = "rig"  # common name in the rig's certificate

Rule = tuple[str, str, tuple[str, ...], tuple[str, ...]]  # name, flow, messages, keys
# subject, common names of certificates (None for all clients), rules
Grant = tuple[str, list[str] | None, tuple[Rule, ...]]

STATE_KEYS = ("state/status", "state/role/*", "state/held")
KNOWN_PERSON_RULES: tuple[Rule, ...] = (
    ("listen", "ingress", ("declare_subscriber",), ("stream/**", "event/**")),
    ("receive", "egress", ("put",), ("stream/**", "event/**")),
    ("ask", "ingress", ("query",), (*STATE_KEYS, "config/**")),
    ("answered", "egress", ("reply",), (*STATE_KEYS, "config/**", "cmd/**")),
    ("offered", "egress", ("declare_queryable",), (*STATE_KEYS, "config/**", "cmd/**")),
    ("look", "ingress", ("liveliness_query", "declare_liveliness_subscriber"), ("alive/**",)),
    ("see", "egress", ("liveliness_token",), ("alive/**",)),
)
TWIN_RULES: tuple[Rule, ...] = (
    ("compute", "ingress", ("put",), ("offer/**",)),
    ("hold", "ingress", ("declare_queryable", "reply"), ("state/offers",)),
    ("held", "egress", ("query",), ("state/offers",)),
)
STRANGER_RULES: tuple[Rule, ...] = (
    ("knock", "ingress", ("query",), (f"state/role/{NO_ROLE}",)),
    ("refused", "egress", ("reply",), (f"state/role/{NO_ROLE}",)),
)
ANY_PERSON_RULES: tuple[Rule, ...] = (
    ("order", "ingress", ("query",), ("cmd/*/*",)),
    ("be", "ingress", ("liveliness_token",), ("alive/observer.$*",)),
)
ALL_MESSAGES = (
    *("put", "delete", "query", "reply"),
    *("declare_subscriber", "declare_queryable", "declare_liveliness_subscriber"),
    *("liveliness_token", "liveliness_query"),
)
RIG_RULES: tuple[Rule, ...] = (
    ("from the rig", "ingress", ALL_MESSAGES, ("**",)),
    ("to the rig", "egress", ALL_MESSAGES, ("**",)),
)


def build_people_access(rig: str, people: Mapping[str, str]) -> ZenohSettings:
    """Return zenoh's access settings of the rig's hub; `people` maps common name to role."""
    return _to_zenoh_settings(
        rig,
        [
            *_people_grants(people, [*people, RIG_NAME]),
            ("routers", [*_names_with_role(ROUTER_ROLE, people), RIG_NAME], ANY_PERSON_RULES),
        ],
    )


def build_router_access(rig: str, people: Mapping[str, str]) -> ZenohSettings:
    """Return zenoh's access settings of a router between the rig and these people.

    The router checks clients as the rig does. Otherwise each client behind it could publish to the
    others in the rig's name.
    """
    people_behind = {name: role for name, role in people.items() if role != ROUTER_ROLE}
    return _to_zenoh_settings(
        rig, [*_people_grants(people_behind, people_behind), ("the rig", [RIG_NAME], RIG_RULES)]
    )


def build_open_access(rig: str, *, remote_twin: bool = False) -> ZenohSettings:
    """Return zenoh's access settings of a loopback hub: every client may query and command.

    No client may publish or reply in the rig's name; `remote_twin` allows offers of a twin.
    """
    rules = (*KNOWN_PERSON_RULES, *ANY_PERSON_RULES, *(TWIN_RULES if remote_twin else ()))
    return _to_zenoh_settings(rig, [("anybody", None, rules)])


def _people_grants(people: Mapping[str, str], known: Iterable[str]) -> list[Grant]:
    return [
        ("anybody", None, STRANGER_RULES),
        ("known", list(known), KNOWN_PERSON_RULES),
        ("twins", _names_with_role("twin", people), TWIN_RULES),
        *((f"person {name}", [name], _own_rules(name)) for name in people),
    ]


def _names_with_role(role: str, people: Mapping[str, str]) -> list[str]:
    return [name for name, person_role in people.items() if person_role == role]


def _own_rules(name: str) -> tuple[Rule, ...]:
    return (
        (f"order as {name}", "ingress", ("query",), (f"cmd/*/{name}",)),
        (f"be {name}", "ingress", ("liveliness_token",), (f"alive/observer.{name}.$*",)),
    )


def _to_zenoh_settings(rig: str, grants: Iterable[Grant]) -> ZenohSettings:
    """Convert grants to zenoh's rules, subjects and policies."""
    zenoh_rules: list[ZenohSettings] = []
    subjects: list[ZenohSettings] = []
    policies: list[ZenohSettings] = []
    for subject, names, rules in grants:
        if names == []:
            continue  # zenoh rejects an empty list and reads an absent one as all clients
        subjects.append({"id": subject} | ({} if names is None else {"cert_common_names": names}))
        policies.append({"subjects": [subject], "rules": [rule[0] for rule in rules]})
        for name, flow, messages, suffixes in rules:
            keys = [f"shaketwin/{rig}/{key}" for key in suffixes]
            rule = {"id": name, "permission": "allow", "flows": [flow]}
            zenoh_rules.append(rule | {"messages": list(messages), "key_exprs": keys})
    base = {"enabled": True, "default_permission": "deny"}
    lists = {"rules": zenoh_rules, "subjects": subjects, "policies": policies}
    return {"access_control": base | lists}


class NamedKeys(Protocol):
    """Keys of a person or of the rig, as `Credentials`."""

    @property
    def name(self) -> str:
        """Common name of the certificate."""


def user_name(keys: NamedKeys | None) -> str:
    """Return the name in the certificate; without keys the login name on this machine."""
    if keys is not None:
        return keys.name
    return re.sub(r"[^A-Za-z0-9_.-]", "_", getpass.getuser())[:64] or "unknown"
