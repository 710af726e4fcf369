"""Topics: the validator, the matcher and the trees, held against naive ones."""

from __future__ import annotations

import sys
from itertools import product

import pytest

from appliance.mqtt.topics import (
    LISTED_PER_STEP,
    SubscriptionTree,
    TopicTree,
    check_filter,
    check_topic,
    matches,
    overlaps,
    parse_shared,
)

DEEP = "/" * 65_535
"""A topic of 65,536 levels, all of them empty: the deepest there is."""


def naive_matches(topic_filter: str, topic: str) -> bool:
    """Section 4.7, word for word and slowly."""

    def below(wanted: list[str], levels: list[str]) -> bool:
        if not wanted:
            return not levels
        if wanted[0] == "#":
            return True
        if not levels:
            return False
        return (wanted[0] == "+" or wanted[0] == levels[0]) and below(wanted[1:], levels[1:])

    if topic.startswith("$") and topic_filter[0] in "+#":
        return False
    return below(topic_filter.split("/"), topic.split("/"))


@pytest.mark.parametrize("topic", ["a", "/", "/a", "a/", "a//b", "$SYS/x", " ", "ä/€", DEEP])
def test_topic(topic):
    check_topic(topic)
    check_filter(topic)


@pytest.mark.parametrize(
    ("topic", "why"),
    [
        ("", "empty"),
        ("a/+", "+ or #"),
        ("#", "+ or #"),
        ("a+b", "+ or #"),
        ("a\0b", "U+0000"),
        ("x" * 65_536, "65535"),
        ("€" * 21_846, "65535"),
    ],
)
def test_no_topic(topic, why):
    with pytest.raises(ValueError) as caught:
        check_topic(topic)
    assert why in str(caught.value)


def test_the_longest_topics():
    check_topic("x" * 65_535)
    check_topic("€" * 21_845)
    check_filter("+/" * 32_767 + "#")
    with pytest.raises(ValueError, match="surrogates"):
        check_topic("\ud800" * 20_000)


# The examples of section 4.7.1.
@pytest.mark.parametrize(
    "good", ["#", "+", "/+", "+/#", "a/#", "a/+", "+/+", "+/a/#", "a/+/b", "/#", "+//+", "$SYS/#"]
)
def test_filter(good):
    check_filter(good)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("", "empty"),
        ("a#", "# must be"),
        ("a/b#", "# must be"),
        ("#/a", "# must be"),
        ("a/#/b", "# must be"),
        ("##", "# must be"),
        ("a+", "+ must be"),
        ("+a/b", "+ must be"),
        ("++", "+ must be"),
        ("+#", "# must be"),
        ("a\0", "U+0000"),
        ("x" * 65_536, "65535"),
    ],
)
def test_no_filter(bad, why):
    with pytest.raises(ValueError) as caught:
        check_filter(bad)
    assert why in str(caught.value)


def test_shared():
    assert parse_shared("a/b") is None
    assert parse_shared("$share") is None
    assert parse_shared("$shared/g/a") is None
    assert parse_shared("$share/g/a/+/#") == ("g", "a/+/#")
    assert parse_shared("$share/g//a") == ("g", "/a")


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("$share/", "needs a group"),
        ("$share//a", "needs a group"),
        ("$share/g", "needs a filter"),
        ("$share/g/", "must not be empty"),
        ("$share/g+/a", "must not hold"),
        ("$share/#/a", "must not hold"),
        ("$share/g/a#", "# must be"),
    ],
)
def test_no_shared(bad, why):
    with pytest.raises(ValueError, match=why):
        parse_shared(bad)


# The examples of sections 4.7.1 and 4.7.2.
@pytest.mark.parametrize(
    ("topic_filter", "topic", "expected"),
    [
        ("sport/tennis/player1/#", "sport/tennis/player1", True),
        ("sport/tennis/player1/#", "sport/tennis/player1/ranking", True),
        ("sport/tennis/player1/#", "sport/tennis/player1/score/wimbledon", True),
        ("sport/#", "sport", True),
        ("sport/#", "sports", False),
        ("sport/tennis/+", "sport/tennis/player1", True),
        ("sport/tennis/+", "sport/tennis/player1/ranking", False),
        ("sport/+", "sport", False),
        ("sport/+", "sport/", True),
        ("+/+", "/finance", True),
        ("/+", "/finance", True),
        ("+", "/finance", False),
        ("#", "$SYS/x", False),
        ("+/monitor/Clients", "$SYS/monitor/Clients", False),
        ("$SYS/#", "$SYS/x", True),
        ("$SYS/monitor/+", "$SYS/monitor/Clients", True),
        ("ACCOUNTS", "Accounts", False),
        ("a/#", "a/$b", True),
        ("a/+", "a/$b", True),
        ("+/" * 3 + "#", "a/b", False),
        ("#", DEEP, True),
        ("/" * 65_534 + "#", DEEP, True),
    ],
)
def test_matches(topic_filter, topic, expected):
    assert matches(topic_filter, topic) is expected
    if len(topic) < 1000:
        assert naive_matches(topic_filter, topic) is expected


# Every topic of up to four levels. "b" is in no filter: it stands for all other names.
TOPICS = [
    topic
    for depth in range(1, 5)
    for levels in product(["", "a", "b", "$", "$a"], repeat=depth)
    if (topic := "/".join(levels))
]
# Every filter of up to three levels: four are enough to tell any two of them apart.
FILTERS = [
    topic_filter
    for depth in range(3)
    for levels in product(["", "a", "$", "+"], repeat=depth)
    for last in ["", "a", "$", "+", "#"]
    if (topic_filter := "/".join([*levels, last]))
]


@pytest.fixture(scope="module")
def matched():
    """For each filter the set of topics that it matches, as the bits of an integer."""
    return {
        topic_filter: sum(
            1 << place for place, topic in enumerate(TOPICS) if naive_matches(topic_filter, topic)
        )
        for topic_filter in FILTERS
    }


def test_matches_as_the_naive_one(matched):
    for topic_filter in FILTERS:
        check_filter(topic_filter)
        fast = sum(1 << i for i, topic in enumerate(TOPICS) if matches(topic_filter, topic))
        assert fast == matched[topic_filter], topic_filter


def test_overlaps_as_the_naive_one(matched):
    for a, b in product(FILTERS, FILTERS):
        assert overlaps(a, b) is bool(matched[a] & matched[b]), (a, b)


@pytest.mark.parametrize(
    ("a", "b", "overlap"),
    [
        ("#", "$SYS/#", False),
        ("+/x", "$SYS/x", False),
        ("$SYS/#", "$SYS/+/x", True),
        ("a/#", "a", True),
        ("a/+", "a/#", True),
        ("+/#", "#", True),
        ("/+/#", "/#", True),
        ("+", "/#", False),
        ("a/+/c", "+/b/+", True),
        ("a/b", "a/c", False),
    ],
)
def test_overlaps(a, b, overlap):
    assert overlaps(a, b) is overlaps(b, a) is overlap


def test_overlaps_at_any_depth():
    assert overlaps(DEEP, "#")


def test_subscription_tree():
    tree: SubscriptionTree[str] = SubscriptionTree()
    assert tree.add("a/+", 1, "one")
    assert not tree.add("a/+", 1, "uno")
    assert tree.add("a/+", 2, "two")
    assert tree.add("a/#", 1, "three")
    assert len(tree) == 3
    assert sorted(tree.match("a/b")) == ["three", "two", "uno"]
    assert tree.match("a") == ["three"]
    assert tree.match("b") == []
    assert not tree.remove("a/+", 3)
    assert not tree.remove("a", 1)
    assert not tree.remove("a/b/c", 1)
    assert tree.remove("a/+", 1)
    assert not tree.remove("a/+", 1)
    assert tree.remove("a/+", 2)
    assert tree.remove("a/#", 1)
    assert len(tree) == 0
    assert not tree._root.children


def test_removing_leaves_the_other_branches():
    tree: SubscriptionTree[int] = SubscriptionTree()
    tree.add("a", 1, 1)
    tree.add("a/b/c", 1, 2)
    tree.add("a/b/d", 1, 3)
    tree.remove("a/b/c", 1)
    assert tree.match("a/b/d") == [3]
    tree.remove("a/b/d", 1)
    assert tree.match("a") == [1]
    assert not tree._root.children["a"].children


def test_all_filters_in_one_tree(matched):
    tree: SubscriptionTree[str] = SubscriptionTree()
    for topic_filter in FILTERS:
        tree.add(topic_filter, 1, topic_filter)
    for place, topic in enumerate(TOPICS):
        expected = [f for f in FILTERS if matched[f] >> place & 1]
        assert sorted(tree.match(topic)) == sorted(expected)


def test_all_topics_in_one_tree(matched):
    tree: TopicTree[int] = TopicTree()
    for place, topic in enumerate(TOPICS):
        tree.set(topic, place)
    for topic_filter in FILTERS:
        found = list(tree.find(topic_filter))
        assert len(found) == len(set(found))
        assert sum(1 << place for _, place in found) == matched[topic_filter]
        assert all(TOPICS[place] == topic for topic, place in found)


def test_topic_tree():
    tree: TopicTree[int] = TopicTree()
    tree.set("a/b", 1)
    tree.set("a/b", 2)
    tree.set("a", 3)
    assert len(tree) == 2
    assert (tree.get("a/b"), tree.get("a"), tree.get("a/b/c"), tree.get("b")) == (2, 3, None, None)
    assert dict(tree.find("a/#")) == {"a": 3, "a/b": 2}
    assert not tree.delete("b")
    assert tree.delete("a")
    assert not tree.delete("a")
    assert tree.get("a") is None
    tree.set("a/b/c", 4)
    assert tree.delete("a/b/c")
    assert tree.get("a/b") == 2
    assert tree.delete("a/b")
    assert len(tree) == 0
    assert not tree._root.children


def test_find_bears_changes_meanwhile():
    tree: TopicTree[int] = TopicTree()
    for number in range(100):
        tree.set(f"a/{number}/x", number)
    found = tree.find("#")
    assert next(found) == ("a/0/x", 0)
    for number in range(50, 100):
        tree.delete(f"a/{number}/x")
        tree.set(f"b/{number}", number)
    assert {topic for topic, _ in found} >= {f"a/{number}/x" for number in range(1, 50)}


@pytest.mark.parametrize("topic_filter", ["a/+", "a/#", "a/+/b"])
def test_to_list_the_children_of_a_level_is_counted_when_it_is_done(topic_filter):
    tree: TopicTree[int] = TopicTree()
    for number in range(1_000):
        tree.set(f"a/{number}", number)

    def steps() -> int:
        return list(tree.find_in_steps(topic_filter)).count(None)

    first, second = steps(), steps()
    assert first == second + 1_000 // LISTED_PER_STEP
    tree.set("a/new", 0)
    assert steps() == first
    assert steps() == second
    # Before it is done: who goes away meanwhile has not paid, and nobody has waited.
    tree.set("a/newer", 0)
    assert next(tree.find_in_steps(topic_filter)) is None
    assert tree._root.children["a"].listing is None


def calls(function, *arguments) -> int:
    """How many calls `function` makes: its cost, without a clock."""
    count = 0

    def profile(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(profile)
    try:
        function(*arguments)
    finally:
        sys.setprofile(None)
    return count


def test_other_topics_cost_nothing():
    tree: SubscriptionTree[int] = SubscriptionTree()
    tree.add("a/b/c", 1, 1)
    tree.add("a/+/c", 1, 2)
    before = calls(tree.match, "a/b/c")
    for number in range(10_000):
        tree.add(f"other/{number}", 1, number)
        tree.add(f"a/b/{number}", 1, number)
        tree.add(f"a/{number}/+", 1, number)
    assert calls(tree.match, "a/b/c") == before


def test_many_wildcards_are_visited_once_each():
    tree: SubscriptionTree[int] = SubscriptionTree()
    topic = "/".join(["a"] * 10)
    for number, levels in enumerate(product("a+", repeat=10)):
        tree.add("/".join(levels), 1, number)
    assert sorted(tree.match(topic)) == list(range(1024))
    nodes = 2**11 - 1
    assert calls(tree.match, topic) < 5 * nodes

    # One filter of nothing but +, as long as the topic: one node a level.
    tree = SubscriptionTree()
    tree.add("+/" * 30_000 + "#", 1, 1)
    assert tree.match("/" * 30_000) == [1]
    assert calls(tree.match, "/" * 30_000) < 5 * 30_001


def test_the_deepest_topic():
    tree: SubscriptionTree[int] = SubscriptionTree()
    tree.add(DEEP, 1, 1)
    tree.add("/" * 65_534 + "#", 1, 2)
    tree.add("+/" * 32_767 + "#", 1, 3)
    assert sorted(tree.match(DEEP)) == [1, 2, 3]
    topics: TopicTree[int] = TopicTree()
    topics.set(DEEP, 1)
    assert list(topics.find("#")) == list(topics.find("/" * 65_534 + "#")) == [(DEEP, 1)]
    assert topics.get(DEEP) == 1
    assert tree.remove(DEEP, 1)
    assert topics.delete(DEEP)
    assert not topics._root.children
    # Dropped while it is deep: freeing a chain of nodes must not recurse without bound either.
    topics.set(DEEP, 1)
    del tree, topics


def test_a_search_says_what_it_passed_also_when_nothing_matches():
    tree: SubscriptionTree[int] = SubscriptionTree()
    for number, levels in enumerate(product("a+", repeat=8)):
        tree.add("/".join([*levels, "end"]), 1, number)
    assert tree.match("/".join(["a"] * 8 + ["other"])) == []
    assert tree.visited == 9 + 2**9 - 1  # the topic's levels, and all nodes above the last ones
    assert tree.match("other") == []
    assert tree.visited == 1 + 1 + 1  # the root, and its +
    assert tree.match("$other") == []
    assert tree.visited == 1 + 1
