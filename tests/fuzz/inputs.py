"""What is fed to the broker: packets of both versions made at random, and damage done to them."""

from __future__ import annotations

import random
from collections.abc import Sequence

from appliance.mqtt.codec import (
    PROPERTY_RULES,
    WILL,
    Kind,
    PacketType,
    Properties,
    Property,
    encode_varint,
)
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
    Will,
)

#: Where boundaries lie: of one, two and three bytes of length, and of what two bytes can say.
EDGES = (0, 1, 2, 3, 126, 127, 128, 129, 255, 256, 16383, 16384, 65535)

#: Bytes with a meaning, somewhere.
TELLING = b"\x00\x01\x02\x04\x10\x1f\x20\x26\x30\x32\x34\x3d\x62\x7f\x80\x82\xa2\xc0\xe0\xf0\xff"

#: Strings that are wrong or strange in UTF-8: surrogates, overlong forms, U+0000, a mark, the last
#: character there is, and one beyond it.
STRANGE = (
    b"\xed\xa0\x80",
    b"\xc0\xaf",
    b"\0",
    b"\xef\xbb\xbf",
    b"\xf4\x8f\xbf\xbf",
    b"\xf4\x90\x80\x80",
    b"\xef\xbf\xbf",
    b"\x80",
)

#: Of enhanced authentication.
METHOD = "SCRAM-SHA-256"

#: From client to server.
CLIENTS_OWN = (
    PacketType.PUBLISH,
    PacketType.PUBACK,
    PacketType.PUBREC,
    PacketType.PUBREL,
    PacketType.PUBCOMP,
    PacketType.SUBSCRIBE,
    PacketType.UNSUBSCRIBE,
    PacketType.PINGREQ,
    PacketType.DISCONNECT,
    PacketType.AUTH,
)


class Source:
    """Makes valid packets; with few topics, ids and packet ids, so that they meet each other."""

    def __init__(self, rng: random.Random, area: str = "fuzz") -> None:
        self.rng = rng
        self.area = area

    def size(self, most: int = 65535) -> int:
        """A length: short most often, at an edge sometimes."""
        rng = self.rng
        if rng.random() < 0.9:
            return rng.randint(0, min(12, most))
        return min(rng.choice(EDGES), most)

    def text(self, most: int = 65535) -> str:
        size = self.size(most)
        alphabet = self.rng.choice(("ab/", "a", "é/", "xyz $", "\ufeffa"))
        text = "".join(self.rng.choices(alphabet, k=min(size, 16)))
        if size > 16:
            text += "x" * (size - len(text.encode()))
        return text

    def binary(self) -> bytes:
        size = self.size()
        return self.rng.randbytes(min(size, 16)) + bytes(max(0, size - 16))

    def topic(self) -> str:
        rng = self.rng
        levels = [self.area, *rng.choices(["a", "b", "c", "", "$x"], k=rng.randint(0, 3))]
        if rng.random() < 0.02:
            levels.append("x" * min(self.size(), 60000))
        if rng.random() < 0.02:
            levels += ["d"] * 250
        return rng.choice(("$SYS", "other")) if rng.random() < 0.02 else "/".join(levels)

    def filter(self) -> str:
        rng = self.rng
        levels = self.topic().split("/")
        for index in range(len(levels)):
            if rng.random() < 0.3:
                levels[index] = "+"
        if rng.random() < 0.3:
            levels = [*levels[: rng.randint(0, len(levels))], "#"]
        text = "/".join(levels)
        if rng.random() < 0.1:
            text = f"$share/{rng.choice('gh')}/{text}"
        return text if rng.random() < 0.95 else rng.choice(("#a", "a/+b", "", "$share/g", "a/#/b"))

    def packet_id(self) -> int:
        return self.rng.choice((1, 2, 3, 4, 5, 20, 21, 65535, self.rng.randint(1, 65535)))

    def properties(self, owner: int) -> Properties | None:
        """What this packet may hold, by the table of the standard."""
        rng = self.rng
        if rng.random() < 0.4:
            return None
        allowed = [one for one in Property if owner in PROPERTY_RULES[one].owners]
        rng.shuffle(allowed)
        properties: Properties = {}
        for one in allowed[: rng.choice((0, 1, 1, 2, 3, len(allowed)))]:
            rule = PROPERTY_RULES[one]
            if one is Property.RESPONSE_TOPIC:
                properties[one] = self.topic()
            elif rule.kind is Kind.STRING:
                properties[one] = self.text(1000)
            elif rule.kind is Kind.BINARY:
                properties[one] = self.binary()[:1000]
            elif rule.kind is Kind.STRING_PAIR:
                count = rng.choice((1, 1, 2, 5, 200))
                properties[one] = [(self.text(200), self.text(200)) for _ in range(count)]
            elif rule.kind is Kind.VARINT:
                count = rng.choice((1, 1, 3)) if owner in rule.repeatable else 1
                properties[one] = [rng.choice((1, 127, 128, 268_435_455)) for _ in range(count)]
            else:
                most = min(rule.maximum, (1 << 8 * rule.kind.value) - 1)
                small = min(most, rule.minimum + rng.randint(0, 12))
                properties[one] = rng.choice((rule.minimum, small, small, most))
        if Property.AUTHENTICATION_DATA in properties:
            properties.setdefault(Property.AUTHENTICATION_METHOD, METHOD)
        return properties or None

    def connect(
        self, version: int, client_id: str, username: str | None, password: bytes
    ) -> Connect:
        """A CONNECT of somebody who has the password."""
        rng = self.rng
        five = version == 5
        will = None
        if rng.random() < 0.4:
            will = Will(self.topic(), self.binary(), rng.randint(0, 2), rng.random() < 0.3)
            will.properties = self.properties(WILL) if five else None
        properties = self.properties(PacketType.CONNECT) if five else None
        if properties and rng.random() < 0.8:  # else few would ever come in
            properties.pop(Property.AUTHENTICATION_METHOD, None)
            properties.pop(Property.AUTHENTICATION_DATA, None)
        return Connect(
            client_id,
            rng.random() < 0.5,
            rng.choice((0, 0, 1, 60, 65535)),
            version,
            username,
            password if username is not None else None,
            will,
            properties or None,
        )

    def packet(self, version: int, kinds: Sequence[PacketType] = CLIENTS_OWN) -> Packet:
        """Any packet of these kinds."""
        rng = self.rng
        five = version == 5
        kind = rng.choice(kinds)

        def held() -> Properties | None:
            return self.properties(kind) if five else None

        def code(cls: type) -> int:
            return rng.choice(sorted(cls.REASONS)) if five and rng.random() < 0.3 else 0

        if kind is PacketType.PUBLISH:
            qos = rng.randint(0, 2)
            properties = held()
            topic = self.topic()
            if properties and Property.TOPIC_ALIAS in properties and rng.random() < 0.5:
                topic = ""
            if properties and rng.random() < 0.9:
                properties.pop(Property.SUBSCRIPTION_IDENTIFIER, None)  # only servers send it
            return Publish(
                topic or self.area,
                self.binary(),
                qos,
                rng.random() < 0.3,
                qos > 0 and rng.random() < 0.2,
                self.packet_id() if qos else None,
                properties or None,
            )
        for cls in (Puback, Pubrec, Pubrel, Pubcomp):
            if kind is cls.TYPE:
                return cls(self.packet_id(), code(cls), held())
        if kind is PacketType.SUBSCRIBE:
            return Subscribe(self.packet_id(), self._subscriptions(five), held())
        if kind is PacketType.UNSUBSCRIBE:
            names = [self.filter() for _ in range(rng.choice((1, 1, 2, 5)))]
            return Unsubscribe(self.packet_id(), names, held())
        if kind is PacketType.DISCONNECT:
            return Disconnect(rng.choice((0, 4, 0x81)) if five else 0, held())
        if kind is PacketType.AUTH and five:
            properties = {Property.AUTHENTICATION_METHOD: METHOD, **(held() or {})}
            return Auth(rng.choice((0, 0x18, 0x19)), properties)
        if kind is PacketType.SUBACK:
            return Suback(self.packet_id(), [0, 1, 0x80], held())
        if kind is PacketType.UNSUBACK:
            return Unsuback(self.packet_id(), [0, 0x11] if five else (), held())
        if kind is PacketType.CONNACK:
            return Connack(False, 0, held())
        if kind is PacketType.CONNECT:
            return self.connect(version, self.text(20), "user", b"secret")
        return Pingresp() if kind is PacketType.PINGRESP else Pingreq()

    def _subscriptions(self, five: bool) -> list[Subscription]:
        rng = self.rng
        found = []
        for _ in range(rng.choice((1, 1, 2, 5, 40))):
            name, qos = self.filter(), rng.randint(0, 2)
            if not five:
                found.append(Subscription(name, qos))
                continue
            alone = rng.random() < 0.3 and not name.startswith("$share/")
            options = alone, rng.random() < 0.3, rng.randint(0, 2)
            found.append(Subscription(name, qos, *options))
        return found


def damage(rng: random.Random, data: bytes, other: bytes = b"") -> bytes:
    """The bytes with one to a few things wrong; `other` is what may be spliced in."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        place = rng.randrange(len(out) + 1)
        if rng.random() < 0.5:
            place = min(place, rng.randrange(12))  # where the lengths and flags are
        end = min(len(out), place + rng.choice((1, 1, 2, 4, 16, 200)))
        what = rng.randrange(10)
        if what == 0 and place < len(out):
            out[place] ^= 1 << rng.randrange(8)
        elif what == 1 and place < len(out):
            out[place] = rng.choice(TELLING)
        elif what == 2:
            out.insert(place, rng.choice(TELLING))
        elif what == 3:
            del out[place:end]
        elif what == 4:
            out[place:place] = out[place:end] * rng.choice((1, 2, 50))
        elif what == 5:
            del out[place:]
        elif what == 6:
            out[place:place] = rng.choice(STRANGE)
        elif what == 7 and place + 2 <= len(out):
            out[place : place + 2] = rng.choice(EDGES).to_bytes(2, "big")
        elif what == 8:
            length = rng.choice((*EDGES, len(out) + 1, 1 << 20, 268_435_455))
            out[1:2] = encode_varint(length) if rng.random() < 0.8 else b"\xff\xff\xff\xff\xff"
        elif what == 9 and other:
            cut = rng.randrange(len(other))
            out[place:end] = other[cut:]
    return bytes(out)


def chunks(rng: random.Random, data: bytes) -> list[bytes]:
    """The data cut up: whole, byte by byte, or anywhere."""
    way = rng.randrange(4)
    if way == 0 or len(data) < 2:
        return [data]
    if way == 1 and len(data) < 400:
        return [data[index : index + 1] for index in range(len(data))]
    cuts = sorted(rng.sample(range(1, len(data)), min(len(data) - 1, rng.randint(1, 8))))
    return [data[start:end] for start, end in zip([0, *cuts], [*cuts, len(data)], strict=True)]
