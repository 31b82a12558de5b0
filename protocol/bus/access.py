"""Access control: messages that a participant accepts, by the role in the sender's certificate.

All participants have the same rules, for what comes in. A router passes on what masters and slaves
may say, so that it is trusted like both. An agent has the role of the slaves that it starts, or
that of a router if it listens. A process without a certificate of a role is not heard at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from protocol.bus.credentials import Role

_EVERYTHING: Final = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)
_WATCH: Final = ("declare_liveliness_subscriber", "liveliness_query")
_SERVE: Final = ("reply", "declare_queryable", "liveliness_token")
_ALL = ("doublestep/**",)

MAY_SEND: Final[Mapping[Role, Mapping[tuple[str, ...], tuple[str, ...]]]] = {
    Role.MASTER: {
        ("query", *_WATCH): _ALL,
        _SERVE: ("doublestep/masters/**",),
    },
    Role.SLAVE: {
        _WATCH: _ALL,
        _SERVE: ("doublestep/slaves/**", "doublestep/agents/**"),
    },
    Role.ROUTER: {
        ("query", *_SERVE, *_WATCH): _ALL,
    },
}
"""Kinds of messages and the keys for which each role may send them."""


def access_control() -> dict[str, object]:
    """The ``access_control`` of a Zenoh configuration."""
    rules = [_rule("send", _EVERYTHING, "egress", ("**",))]
    policies = []
    for role, kinds in MAY_SEND.items():
        names = ["send"]
        for number, (messages, keys) in enumerate(kinds.items()):
            names.append(f"{role}-{number}")
            rules.append(_rule(names[-1], messages, "ingress", keys))
        policies.append({"rules": names, "subjects": [str(role)]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": str(role), "cert_common_names": [str(role)]} for role in Role],
        "policies": policies,
    }


def _rule(
    name: str, messages: tuple[str, ...], flow: str, keys: tuple[str, ...]
) -> dict[str, object]:
    return {
        "id": name,
        "messages": list(messages),
        "flows": [flow],
        "permission": "allow",
        "key_exprs": list(keys),
    }
