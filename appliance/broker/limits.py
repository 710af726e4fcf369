"""The broker's limits and options, as `broker` in appliance.yaml sets them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

#: The largest packet, in bytes, that is accepted where CONNACK announces no limit.
USUAL_PACKET_SIZE = 16 * 1024 * 1024

#: No payload is larger: the largest Remaining Length of a packet (section 1.5.5).
ANY_SIZE = 0xFFF_FFFF

#: MQTT 3.1, 3.1.1 and 5, as CONNECT names them.
VERSIONS: Final = frozenset((3, 4, 5))

#: Whether clients without a user name are admitted; None: as configured for all listeners. Always:
#: also those that give one, which nobody checks.
Anonymous: TypeAlias = bool | Literal["always"] | None


@dataclass(frozen=True, slots=True)
class UserLimits:
    """Limits of one user, see `accounts`; None lets a user have more while others leave room."""

    connections: int | None = None
    sessions: int | None = None
    memory: int | None = None
    retained_messages: int | None = None
    retained_bytes: int | None = None
    #: Of `Store.size`.
    stored: int | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of everything that clients can make grow; see `broker.limits` in appliance.yaml."""

    connections: int = 1000
    packet_size: int = USUAL_PACKET_SIZE
    payload_size: int = ANY_SIZE
    memory: int = 256 * 1024 * 1024
    queue_messages: int = 1000
    queue_bytes: int = 16 * 1024 * 1024
    queue_full: str = "refuse"
    #: QoS 0 messages that are queued for a slow client; 0: only the latest of each topic.
    keep: int = 0
    inflight: int = 20
    subscriptions: int = 1000
    client_id_length: int = 1024
    topic_length: int = 65535
    topic_levels: int = 201
    retained_messages: int = 100_000
    retained_bytes: int = 64 * 1024 * 1024
    session_expiry: int = 7 * 24 * 3600
    topic_alias: int = 10
    user_properties: int = 1000
    keep_alive: int = 65535
    sessions: int = 10_000
    user: UserLimits = UserLimits()


@dataclass(frozen=True, slots=True)
class Terms:
    """What a listener admits, and whom; see `broker.listeners` in appliance.yaml."""

    anonymous: Anonymous = None
    max_qos: int = 2
    retain: bool = True
    versions: frozenset[int] = VERSIONS
    #: What client ids begin with; with anything where there is none.
    client_id_prefixes: tuple[str, ...] = ()

    @property
    def refused_flags(self) -> int:
        """The bits of a PUBLISH's first byte that may not be set (section 3.3.1).

        QoS 1 and 2 are one bit each, and 3 does not exist.
        """
        return (0x06, 0x04, 0x00)[self.max_qos] | (0 if self.retain else 0x01)


#: Of a listener that restricts nothing.
USUAL_TERMS: Final = Terms()


@dataclass(frozen=True, slots=True)
class Features:
    """Options that the standard leaves to the server's operator; `broker` in appliance.yaml."""

    check_payload_format: bool = False
    reason_strings: bool = False
    #: With %c and %u for the client id and the user name; empty for none.
    response_information: str = ""
