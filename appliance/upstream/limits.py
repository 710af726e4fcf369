"""What a fleet's broker takes: the limits of each kind, and those that a CONNACK announces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, cast

from appliance.config.urls import ServerUrl
from appliance.mqtt.codec import MAX_VARINT, V5, Properties, Property
from appliance.upstream.rules import BrokerKind, UpstreamSettings, UpstreamTls

#: The largest MQTT packet: a fixed header of five bytes, and the largest Remaining Length.
LARGEST_PACKET: Final = 5 + MAX_VARINT

#: Topics that AWS IoT Core passes to a rule: their first three levels count for no limit.
_AWS_RULES: Final = "$aws/rules/"


@dataclass(frozen=True, slots=True)
class FleetLimits:
    """What the fleet's broker takes on one connection. Sizes in bytes, times in seconds.

    `window` is its Receive Maximum, `topic_aliases` the most that it remembers, `filters` the most
    in one SUBSCRIBE. `user_properties` says whether CONNECT, SUBSCRIBE and PUBACK may have some;
    `auth` whether it knows enhanced authentication; `ordered` whether it keeps the order of a
    topic; `retained_for_wildcards` whether a new subscription with a wildcard gets retained
    messages.
    """

    window: int = 65_535
    qos: int = 2
    retain: bool = True
    packet_size: int = LARGEST_PACKET
    topic_size: int = 65_535
    topic_slashes: int = 200  # mosquitto closes the connection upon more
    topic_aliases: int = 65_535
    filters: int | None = None
    client_id_size: int = 65_535
    wildcards: bool = True
    identifiers: bool = True
    shared: bool = True
    user_properties: bool = True
    auth: bool = True
    ordered: bool = True
    retained_for_wildcards: bool = True
    rate: float | None = None
    bytes_per_second: int | None = None
    least_keep_alive: int = 1
    most_keep_alive: int = 65_535
    server_keep_alive: int | None = None
    connect_interval: float = 0.0
    needs_tls: bool = False

    def announced(self, properties: Properties | None, version: int) -> FleetLimits:
        """These limits with what a CONNACK announces (5.0 section 3.2.2.3), the lower of both.

        A limit that it does not name is the standard's default. 3.1.1 announces nothing, and has no
        aliases, identifiers, shared subscriptions and user properties.
        """
        if version != V5:
            return replace(
                self,
                topic_aliases=0,
                identifiers=False,
                shared=False,
                user_properties=False,
                auth=False,
            )
        told = properties or {}

        def number(name: Property, default: int) -> int:
            return cast(int, told.get(name, default))

        return replace(
            self,
            window=min(self.window, number(Property.RECEIVE_MAXIMUM, 65_535)),
            qos=min(self.qos, number(Property.MAXIMUM_QOS, 2)),
            retain=self.retain and number(Property.RETAIN_AVAILABLE, 1) == 1,
            packet_size=min(self.packet_size, number(Property.MAXIMUM_PACKET_SIZE, LARGEST_PACKET)),
            topic_aliases=min(self.topic_aliases, number(Property.TOPIC_ALIAS_MAXIMUM, 0)),
            wildcards=self.wildcards and number(Property.WILDCARD_SUBSCRIPTION_AVAILABLE, 1) == 1,
            identifiers=self.identifiers
            and number(Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE, 1) == 1,
            shared=self.shared and number(Property.SHARED_SUBSCRIPTION_AVAILABLE, 1) == 1,
            server_keep_alive=cast("int | None", told.get(Property.SERVER_KEEP_ALIVE)),
        )

    def keep_alive(self, wanted: int) -> int:
        """The Keep Alive for CONNECT; after CONNACK the one in force.

        What the server says replaces what was wanted: v5 [MQTT-3.1.2-21]. 0 is none.
        """
        if self.server_keep_alive is not None:
            return self.server_keep_alive
        return min(max(wanted, self.least_keep_alive), self.most_keep_alive)

    def rates(
        self, rate: float | None, bytes_per_second: float | None
    ) -> tuple[float | None, float | None]:
        """Messages and bytes a second that may be sent, of which so many are wanted at most."""
        return _least(self.rate, rate), _least(self.bytes_per_second, bytes_per_second)

    def unsendable(self, topic: str, size: int) -> str:
        """Why a PUBLISH of `size` bytes to that topic cannot be sent; empty when it can."""
        if size > self.packet_size:
            return f"{size} bytes, and {self.packet_size} is the most"
        return self.unusable(topic)

    def unusable(self, name: str) -> str:
        """Why a topic or filter cannot be used there; empty when it can."""
        counted = name.split("/", 3)[-1] if name.startswith(_AWS_RULES) else name
        if len(counted.encode()) > self.topic_size:
            return f"a topic of {len(counted.encode())} bytes, and {self.topic_size} is the most"
        slashes = counted.count("/")
        if slashes > self.topic_slashes:
            return f"a topic with {slashes} slashes, and {self.topic_slashes} is the most"
        if not self.wildcards and ("+" in name or "#" in name):
            return "no wildcards in subscriptions"
        return ""


def _least(a: float | None, b: float | None) -> float | None:
    return min((x for x in (a, b) if x is not None), default=None)


#: The limits that a kind of broker has, whatever it announces.
KINDS: Final[dict[BrokerKind, FleetLimits]] = {
    "generic": FleetLimits(),
    # docs.aws.amazon.com/general/latest/gr/iot-core.html, "message broker and protocol limits"
    "aws-iot": FleetLimits(
        window=100,
        qos=1,
        packet_size=128 << 10,
        topic_size=256,
        topic_slashes=7,
        filters=8,
        client_id_size=128,
        auth=False,
        ordered=False,
        retained_for_wildcards=False,
        rate=100,
        bytes_per_second=512 << 10,
        least_keep_alive=30,
        most_keep_alive=1200,
        connect_interval=1.0,
        needs_tls=True,
    ),
    # learn.microsoft.com/azure/event-grid/mqtt-support
    "azure-event-grid": FleetLimits(
        qos=1,
        retain=False,
        packet_size=512 << 10,
        topic_aliases=10,
        identifiers=False,
        shared=False,
        user_properties=False,
        retained_for_wildcards=False,
        most_keep_alive=1160,
        needs_tls=True,
    ),
    # rabbitmq.com/docs/mqtt
    "rabbitmq": FleetLimits(qos=1, shared=False, auth=False, retained_for_wildcards=False),
}

#: The ends of the host names of those kinds.
_HOSTS: Final[dict[str, BrokerKind]] = {
    ".amazonaws.com": "aws-iot",
    ".amazonaws.com.cn": "aws-iot",
    ".eventgrid.azure.net": "azure-event-grid",
}


def kind_of_host(host: str) -> BrokerKind | None:
    """The kind of broker that a host is by its name; None for most."""
    return next((kind for end, kind in _HOSTS.items() if host.lower().endswith(end)), None)


def dialled_tls(settings: UpstreamSettings, server: ServerUrl) -> UpstreamTls:
    """How TLS is spoken with one server of a link."""
    has_login = settings.login.username is not None
    offered = alpn(settings.kind, server.port, settings.tls.alpn, has_login)
    return replace(settings.tls, alpn=tuple(offered))


def alpn(kind: BrokerKind, port: int, configured: tuple[str, ...], has_login: bool) -> list[str]:
    """The application protocols to offer in TLS; empty for none.

    AWS IoT Core has MQTT on port 443 beside HTTPS, and tells by them which is meant: one for
    clients with a certificate, one for those with a login (custom authentication).
    """
    if configured or kind != "aws-iot" or port != 443:
        return list(configured)
    return ["mqtt" if has_login else "x-amzn-mqtt-ca"]
