"""The outgoing side of a session: what a session sends to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from appliance.broker.message import Message
from appliance.mqtt.reason import ReasonCode


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """The state of the connection to a client's computer, as TCP knows it; times in seconds.

    `silence` is the time since anything arrived from that computer, TCP acknowledgements included;
    it is infinity where that is unknown. `has_unread` says that bytes have arrived and are not yet
    processed. `flowing` is for how long the client has sent without a pause. `held` is for how long
    what the client sends now may have waited here because its connection was not read.
    """

    round_trip: float = 0.0
    silence: float = 0.0
    has_unread: bool = False
    flowing: float = 0.0
    held: float = 0.0


#: The status of a peer on this computer: it is alive as long as its connection is open.
LOCAL_PEER = PeerStatus()


class Link(Protocol):
    """The outgoing side of a session: a network connection, or a part of the appliance.

    `Session.pump` is called when the link becomes writable again.
    """

    #: False while the receiver applies backpressure.
    writable: bool

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """Send a PUBLISH; `packet_id` is 0 for QoS 0."""

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """Forward a received QoS 0 PUBLISH unchanged; False if this receiver needs another packet.

        This is the fast path; `publish` always works.
        """

    def pubrel(self, packet_id: int) -> None:
        """Send a PUBREL."""

    def is_behind(self) -> bool:
        """Whether a large QoS 0 message must wait in the session until earlier output is sent.

        `Session.pump` is called when it is.
        """

    def later(self) -> None:
        """Call `Session.pump` again after the other clients have had their turn."""

    def peer_status(self) -> PeerStatus:
        """The state of the connection to the client's computer."""

    def probe(self) -> None:
        """Make the client's computer answer within two seconds, if it is alive."""

    def withhold(self, seconds: float) -> None:
        """Send nothing for this time, not even acknowledgements; 0 ends it."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """Send the reason to the client, where the protocol can, and close the connection."""


class InsideLink:
    """The link of a session inside the appliance; it never applies backpressure.

    This class drops all messages, which is enough for a session that only publishes. A session that
    subscribes overrides `publish`, and subscribes with QoS 0 and without retained messages.

    One that stores messages calls `DiskCongestion.begin` when many of them are not written yet. It
    is then asked about each message by `must_wait`.
    """

    writable = True

    #: Whether what the session publishes with QoS 1 is acknowledged to somebody, who would send it
    #: again.
    acknowledges = False

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """Take a message that matches a subscription."""

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """Ask for `publish`: inside, messages are taken, not packets."""
        return False

    def pubrel(self, packet_id: int) -> None:
        """Do nothing: QoS 2 is not used inside."""

    def is_behind(self) -> bool:
        """Never: every message is taken immediately."""
        return False

    def later(self) -> None:
        """Do nothing: no retained messages are replayed inside."""

    def peer_status(self) -> PeerStatus:
        """Always alive."""
        return LOCAL_PEER

    def probe(self) -> None:
        """Do nothing: it is in this process."""

    def withhold(self, seconds: float) -> None:
        """Do nothing: nothing is acknowledged."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """Do nothing: there is no connection."""

    def must_wait(self, message: Message, client_id: str) -> bool:
        """Whether a QoS 1 or 2 message of that client has to wait for the disk: no."""
        return False

    def rules_changed(self) -> None:
        """The access rules may have changed: subscriptions are neither ended nor granted anew.

        What the session may publish and receive is decided by the new rules already.
        """


class ReceivingLink(InsideLink):
    """Calls `receive` with each message, whether it is a retained one, and the identifiers of the
    subscriptions that it matches."""

    def __init__(self, receive: Callable[[Message, bool, list[int] | None], None]) -> None:
        self._receive = receive

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """Take a message."""
        self._receive(message, retain, subscription_ids)
