"""Who may do what at the gate, as zenoh's access control. What no rule allows is denied.

A rule names a message that comes from a person ("ingress") or goes to one ("egress") and the keys
on which it may be. Only allowing works: a denying rule is escaped by a wider key, as `put("**")`.

| role    | may                                                                           |
|---------|-------------------------------------------------------------------------------|
| observe | subscribe to streams and events, ask for state, history and configuration,    |
|         | see who is there, be there as alive/observer.<own name>.<anything>            |
| record  | the same: what a recorder needs is what an observer may                       |
| twin    | the same, and offer to the gate what a twin computes: none else hears it      |
| command | the same, and be obeyed                                                       |
| router  | the same in the name of whoever is behind it, whom it has to check            |

Everybody known may put the question cmd/<order>/<own name>, so that the gate can refuse in words;
whether it is obeyed is the gate's own look at the role. So a command's last part is who gave it,
and nobody can write another's name there. Whoever has a certificate but is on no list may ask
state/role/none and nothing else: from the answer one knows that there is a rig, which refuses.
"""

from collections.abc import Iterable, Mapping
from typing import Any

ROUTER = "router"
ROLES = ("observe", "record", "twin", "command", ROUTER)
NOBODY = "none"  # the role of whoever has none
RIG = "rig"  # the rig's own name in its certificate

Rule = tuple[str, str, tuple[str, ...], tuple[str, ...]]  # name, flow, messages, keys
# subject, names in certificates (None for whoever it is), what is allowed
Grant = tuple[str, list[str] | None, tuple[Rule, ...]]

STATE = ("state/status", "state/role/*", "state/held")
EVERYBODY_KNOWN: tuple[Rule, ...] = (
    ("listen", "ingress", ("declare_subscriber",), ("stream/**", "event/**")),
    ("hear", "egress", ("put",), ("stream/**", "event/**")),
    ("ask", "ingress", ("query",), (*STATE, "config/**")),
    ("answered", "egress", ("reply",), (*STATE, "config/**", "cmd/**")),
    ("offered", "egress", ("declare_queryable",), (*STATE, "config/**", "cmd/**")),
    ("look", "ingress", ("liveliness_query", "declare_liveliness_subscriber"), ("alive/**",)),
    ("see", "egress", ("liveliness_token",), ("alive/**",)),
)
TWIN: tuple[Rule, ...] = (
    ("compute", "ingress", ("put",), ("offer/**",)),
    ("hold", "ingress", ("declare_queryable", "reply"), ("state/offers",)),
    ("held", "egress", ("query",), ("state/offers",)),
)
STRANGER: tuple[Rule, ...] = (
    ("knock", "ingress", ("query",), (f"state/role/{NOBODY}",)),
    ("refused", "egress", ("reply",), (f"state/role/{NOBODY}",)),
)
ANYBODY: tuple[Rule, ...] = (
    ("order", "ingress", ("query",), ("cmd/*/*",)),
    ("be", "ingress", ("liveliness_token",), ("alive/observer.$*",)),
)
EVERY_MESSAGE = (
    *("put", "delete", "query", "reply"),
    *("declare_subscriber", "declare_queryable", "declare_liveliness_subscriber"),
    *("liveliness_token", "liveliness_query"),
)
THE_RIG: tuple[Rule, ...] = (
    ("from the rig", "ingress", EVERY_MESSAGE, ("**",)),
    ("to the rig", "egress", EVERY_MESSAGE, ("**",)),
)


def people_access(rig: str, people: Mapping[str, str]) -> dict[str, Any]:
    """zenoh's settings of the rig's hub for these people (name in the certificate: role)."""
    return _settings(rig, [*_people(people), ("routers", _having(ROUTER, people), ANYBODY)])


def router_access(rig: str, people: Mapping[str, str]) -> dict[str, Any]:
    """zenoh's settings of a router between the rig and these people: it checks them as the rig.

    Else everybody behind it could publish to the others in the rig's name.
    """
    behind = {name: role for name, role in people.items() if role != ROUTER}
    return _settings(rig, [*_people(behind), ("the rig", [RIG], THE_RIG)])


def open_access(rig: str, *, remote_twin: bool = False) -> dict[str, Any]:
    """zenoh's settings of a hub that only this machine reaches: everybody may ask and order.

    Nobody may publish in the rig's name or answer for it, a twin only where one is expected.
    """
    rules = (*EVERYBODY_KNOWN, *ANYBODY, *(TWIN if remote_twin else ()))
    return _settings(rig, [("anybody", None, rules)])


def _people(people: Mapping[str, str]) -> list[Grant]:
    return [
        ("anybody", None, STRANGER),
        ("known", list(people), EVERYBODY_KNOWN),
        ("twins", _having("twin", people), TWIN),
        *((f"person {name}", [name], _own(name)) for name in people),
    ]


def _having(role: str, people: Mapping[str, str]) -> list[str]:
    return [name for name, one in people.items() if one == role]


def _own(name: str) -> tuple[Rule, ...]:
    return (
        (f"order as {name}", "ingress", ("query",), (f"cmd/*/{name}",)),
        (f"be {name}", "ingress", ("liveliness_token",), (f"alive/observer.{name}.$*",)),
    )


def _settings(rig: str, grants: Iterable[Grant]) -> dict[str, Any]:
    """The grants in zenoh's words."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for subject, names, allowed in grants:
        if names == []:
            continue  # zenoh takes no empty list, and an absent one for everybody
        subjects.append({"id": subject} | ({} if names is None else {"cert_common_names": names}))
        policies.append({"subjects": [subject], "rules": [rule[0] for rule in allowed]})
        for name, flow, messages, keys in allowed:
            where = [f"shaketwin/{rig}/{one}" for one in keys]
            rule = {"id": name, "permission": "allow", "flows": [flow]}
            rules.append(rule | {"messages": list(messages), "key_exprs": where})
    control = {"enabled": True, "default_permission": "deny"}
    lists = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"access_control": control | lists}
