"""What must hold for every packet, for any bytes and for any set of topics."""

from __future__ import annotations

from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, rule

from appliance.mqtt.codec import (
    PROPERTY_RULES,
    WILL,
    Kind,
    PacketType,
    Properties,
    Property,
    decode_varint,
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
    decode_packet,
)
from appliance.mqtt.reason import ProtocolError
from appliance.mqtt.topics import SubscriptionTree, TopicTree, matches, parse_shared

texts = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cn"]), max_size=12)
topics = texts.map(lambda text: text.replace("+", "").replace("#", "")).filter(bool)
binaries = st.binary(max_size=20)
packet_ids = st.integers(1, 0xFFFF)
qos_levels = st.integers(0, 2)


def values(identifier: Property, owner: int) -> st.SearchStrategy:
    entry = PROPERTY_RULES[identifier]
    if identifier is Property.RESPONSE_TOPIC:
        return topics
    if entry.kind is Kind.STRING:
        return texts
    if entry.kind is Kind.BINARY:
        return binaries
    if entry.kind is Kind.STRING_PAIR:
        return st.lists(st.tuples(texts, texts), min_size=1, max_size=3)
    if entry.kind is Kind.VARINT:
        most = 3 if owner in entry.repeatable else 1
        return st.lists(st.integers(1, 268_435_455), min_size=1, max_size=most)
    greatest = min(entry.maximum, (1 << 8 * entry.kind.value) - 1)
    return st.integers(entry.minimum, greatest)


def with_method(properties: Properties) -> Properties:
    if Property.AUTHENTICATION_DATA in properties:
        properties.setdefault(Property.AUTHENTICATION_METHOD, "method")
    return properties


def properties_of(owner: int) -> st.SearchStrategy[Properties | None]:
    allowed = [p for p in Property if owner in PROPERTY_RULES[p].owners]
    some = st.fixed_dictionaries({}, optional={p: values(p, owner) for p in allowed})
    return some.map(with_method).map(lambda properties: properties or None)


def codes(cls: type) -> st.SearchStrategy[int]:
    return st.sampled_from(sorted(cls.REASONS))


@st.composite
def connects(draw, version: int) -> Connect:
    v5 = version == 5
    will = None
    if draw(st.booleans()):
        will_properties = draw(properties_of(WILL)) if v5 else None
        will = Will(draw(topics), draw(binaries), draw(qos_levels), draw(st.booleans()))
        will.properties = will_properties
    username = draw(st.none() | texts)
    password = draw(st.none() | binaries) if v5 or username is not None else None
    return Connect(
        draw(texts),
        draw(st.booleans()),
        draw(st.integers(0, 0xFFFF)),
        version,
        username,
        password,
        will,
        draw(properties_of(PacketType.CONNECT)) if v5 else None,
    )


@st.composite
def publishes(draw, version: int) -> Publish:
    qos = draw(qos_levels)
    properties = draw(properties_of(PacketType.PUBLISH)) if version == 5 else None
    has_alias = properties is not None and Property.TOPIC_ALIAS in properties
    return Publish(
        draw(texts if has_alias else topics),
        draw(binaries),
        qos,
        draw(st.booleans()),
        draw(st.booleans()) if qos else False,
        draw(packet_ids) if qos else None,
        properties,
    )


@st.composite
def subscriptions(draw, version: int) -> Subscription:
    topic_filter, qos = draw(texts), draw(qos_levels)
    if version == 4:
        return Subscription(topic_filter, qos)
    no_local = draw(st.booleans()) and not topic_filter.startswith("$share/")
    return Subscription(topic_filter, qos, no_local, draw(st.booleans()), draw(st.integers(0, 2)))


def packets(version: int) -> st.SearchStrategy[Packet]:
    v5 = version == 5

    def held(packet_type: PacketType) -> st.SearchStrategy[Properties | None]:
        return properties_of(packet_type) if v5 else st.none()

    def acknowledgements(cls: type) -> st.SearchStrategy:
        return st.builds(cls, packet_ids, codes(cls) if v5 else st.just(0), held(cls.TYPE))

    refusals = st.sampled_from([0x84, 0x85, 0x86, 0x87, 0x88])
    granted = st.sampled_from([0, 1, 2, 0x80] + ([0x87, 0x8F, 0x97, 0xA2] if v5 else []))
    choices = [
        connects(version),
        st.builds(Connack, st.booleans(), st.just(0), held(PacketType.CONNACK)),
        st.builds(Connack, st.just(False), refusals, held(PacketType.CONNACK)),
        publishes(version),
        acknowledgements(Puback),
        acknowledgements(Pubrec),
        acknowledgements(Pubrel),
        acknowledgements(Pubcomp),
        st.builds(
            Subscribe,
            packet_ids,
            st.lists(subscriptions(version), min_size=1, max_size=4),
            held(PacketType.SUBSCRIBE),
        ),
        st.builds(
            Suback,
            packet_ids,
            st.lists(granted, min_size=1, max_size=4),
            held(PacketType.SUBACK),
        ),
        st.builds(
            Unsubscribe,
            packet_ids,
            st.lists(texts, min_size=1, max_size=4),
            held(PacketType.UNSUBSCRIBE),
        ),
        st.builds(
            Unsuback,
            packet_ids,
            st.lists(st.sampled_from([0, 0x11, 0x87]), min_size=1, max_size=4)
            if v5
            else st.just(()),
            held(PacketType.UNSUBACK),
        ),
        st.just(Pingreq()),
        st.just(Pingresp()),
        st.builds(
            Disconnect,
            st.sampled_from([0, 4, 0x81, 0x8E]) if v5 else st.just(0),
            held(PacketType.DISCONNECT),
        ),
    ]
    if v5:
        choices.append(st.just(Auth()))
        method = {Property.AUTHENTICATION_METHOD: "method"}
        choices.append(
            st.builds(
                lambda code, properties: Auth(code, {**(properties or {}), **method}),
                st.sampled_from([0, 0x18, 0x19]),
                held(PacketType.AUTH),
            )
        )
    return st.one_of(choices)


versions = st.sampled_from([4, 5])
versioned_packets = versions.flatmap(lambda version: st.tuples(st.just(version), packets(version)))


def split(wire: bytes) -> tuple[int, bytes]:
    """The first byte and the body of a whole packet."""
    length, start = decode_varint(wire, 1)
    assert start + length == len(wire)
    return wire[0], wire[start:]


@given(versioned_packets)
@examples(300)
def test_decode_is_the_inverse_of_encode(versioned):
    version, packet = versioned
    wire = packet.encode(version)
    assert decode_packet(*split(wire), version) == packet
    assert str(packet)


def decodes_or_refuses(first_byte: int, body: bytes, version: int) -> None:
    try:
        packet = decode_packet(first_byte, body, version)
    except ProtocolError as error:
        assert error.code >= 0x80
        assert str(error)
        return
    assert str(packet)
    # What was read can be said again, and then reads the same.
    assert decode_packet(*split(packet.encode(version)), version) == packet


@given(st.integers(0, 255), st.binary(max_size=60), versions)
@examples(300)
def test_any_bytes_are_a_packet_or_a_protocol_error(first_byte, body, version):
    decodes_or_refuses(first_byte, body, version)


edits = st.lists(
    st.tuples(st.sampled_from(["set", "insert", "delete"]), st.integers(0), st.integers(0, 255)),
    max_size=3,
)


@given(versioned_packets, edits, versions)
@examples(400)
def test_damaged_packets_are_a_packet_or_a_protocol_error(versioned, edits, read_as):
    version, packet = versioned
    first_byte, body = split(packet.encode(version))
    damaged = bytearray(body)
    for what, place, byte in edits:
        place %= len(damaged) + 1
        if what == "insert":
            damaged.insert(place, byte)
        elif place < len(damaged):
            if what == "set":
                damaged[place] = byte
            else:
                del damaged[place]
    decodes_or_refuses(first_byte, bytes(damaged), version)
    decodes_or_refuses(first_byte, bytes(damaged), read_as)


@given(st.integers(0, 268_435_455))
def test_varint(value):
    wire = encode_varint(value)
    assert decode_varint(wire, 0) == (value, len(wire))
    assert 1 <= len(wire) <= 4


@given(st.text("$share/+#ab", max_size=16))
def test_shared_filters_are_parsed_or_refused(topic_filter):
    try:
        shared = parse_shared(topic_filter)
    except ValueError:
        return
    if shared is not None:
        assert topic_filter == "$share/{}/{}".format(*shared)


level_names = st.sampled_from(["", "a", "b", "$", "$a"])
some_topics = st.lists(level_names, min_size=1, max_size=5).map("/".join).filter(bool)
some_filters = (
    st.tuples(
        st.lists(level_names | st.just("+"), max_size=4), level_names | st.sampled_from(["+", "#"])
    )
    .map(lambda levels: "/".join([*levels[0], levels[1]]))
    .filter(bool)
)


class Trees(RuleBasedStateMachine):
    """Both trees against plain dictionaries, with `matches` as the matcher."""

    filters = Bundle("filters")
    topics = Bundle("topics")

    def __init__(self) -> None:
        super().__init__()
        self.subscriptions: SubscriptionTree[int] = SubscriptionTree()
        self.subscription_model: dict[tuple[str, int], int] = {}
        self.retained: TopicTree[int] = TopicTree()
        self.retained_model: dict[str, int] = {}

    @rule(target=filters, topic_filter=some_filters)
    def a_filter(self, topic_filter):
        return topic_filter

    @rule(target=topics, topic=some_topics)
    def a_topic(self, topic):
        return topic

    @rule(topic_filter=filters, key=st.integers(0, 2), value=st.integers())
    def add(self, topic_filter, key, value):
        new = (topic_filter, key) not in self.subscription_model
        assert self.subscriptions.add(topic_filter, key, value) is new
        self.subscription_model[topic_filter, key] = value

    @rule(topic_filter=filters, key=st.integers(0, 2))
    def remove(self, topic_filter, key):
        was_there = self.subscription_model.pop((topic_filter, key), None) is not None
        assert self.subscriptions.remove(topic_filter, key) is was_there

    @rule(topic=topics, value=st.integers())
    def set(self, topic, value):
        self.retained.set(topic, value)
        self.retained_model[topic] = value

    @rule(topic=topics)
    def delete(self, topic):
        was_there = self.retained_model.pop(topic, None) is not None
        assert self.retained.delete(topic) is was_there

    @rule(topic=topics)
    def match(self, topic):
        model = self.subscription_model.items()
        expected = [value for (wanted, _), value in model if matches(wanted, topic)]
        assert sorted(self.subscriptions.match(topic)) == sorted(expected)

    @rule(topic_filter=filters)
    def find(self, topic_filter):
        found = list(self.retained.find(topic_filter))
        model = self.retained_model.items()
        assert dict(found) == {t: v for t, v in model if matches(topic_filter, t)}
        assert len(found) == len(dict(found))

    @invariant()
    def sizes(self):
        assert len(self.subscriptions) == len(self.subscription_model)
        assert len(self.retained) == len(self.retained_model)
        assert bool(self.subscriptions._root.children) is bool(self.subscription_model)
        assert bool(self.retained._root.children) is bool(self.retained_model)


TestTrees = Trees.TestCase
TestTrees.settings = examples(150, stateful_step_count=40)
