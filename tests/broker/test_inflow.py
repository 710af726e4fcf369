"""The age of received messages, with a simulated clock."""

from __future__ import annotations

import pytest

from appliance.broker.inflow import (
    CATCHING_UP,
    LITTLE,
    PAUSE,
    PAUSE_BEHIND,
    SECONDS_PER_BYTE,
    Inflow,
)

COMMAND = b"0" * 60


class Sending:
    """Its chunks come when the test says. What is compiled cannot be derived from."""

    def __init__(self):
        self.__dict__.update(inflow=Inflow(), now=100.0)
        self.flowing(self.now)

    def __getattr__(self, name):
        return getattr(self.inflow, name)

    def __setattr__(self, name, value):
        if name in self.__dict__:
            self.__dict__[name] = value
        else:
            setattr(self.inflow, name, value)

    def hear(self, after, data=COMMAND):
        self.now += after
        self.chunk_received(data, self.now)

    def age(self, *, has_unread=False):
        return self.held(self.now, has_unread=has_unread)

    def see(self, *, unread=False, full=False, received=0, round_trip=0.0):
        return self.check(
            self.now, unread=unread, full=full, received=received, round_trip=round_trip
        )


def test_what_comes_at_once_flows_since_its_first_byte():
    inflow = Sending()
    for _ in range(50):
        inflow.hear(PAUSE)
    assert inflow.flowing(inflow.now) == pytest.approx(50 * PAUSE)
    inflow.hear(3 * PAUSE)
    assert inflow.flowing(inflow.now) == 0
    inflow.hear(PAUSE / 2)
    assert inflow.flowing(inflow.now) == pytest.approx(PAUSE / 2)
    assert inflow.flowing(inflow.now + 2 * PAUSE) == 0


def test_a_pause_in_the_middle_of_a_packet_is_none():
    """A slow network makes it, and not who has nothing more to say."""
    inflow = Sending()
    inflow.unfinished = inflow.now
    inflow.hear(1.0)
    assert inflow.flowing(inflow.now) == 1.0
    assert inflow.flowing(inflow.now + 2) == 3.0


def test_nor_one_that_the_next_bytes_took_to_come():
    """TLS hands over whole records only, of up to 16 KiB."""
    record = bytes(16384)
    inflow = Sending()
    for _ in range(10):
        inflow.hear(len(record) * SECONDS_PER_BYTE, record)
    assert inflow.flowing(inflow.now) > 0.1
    inflow.hear(0.05, record)
    assert inflow.flowing(inflow.now) == 0


@pytest.mark.parametrize("data", [b"\x40\2\0\1", b"\x62\2\0\1" * 9, b"\x40\2\0\1\x50\2\0\2"])
def test_acknowledgements_neither_end_a_pause_nor_fill_it(data):
    inflow = Sending()
    for _ in range(9):
        inflow.hear(0.001, data)
    inflow.hear(0.001)
    assert inflow.flowing(inflow.now) == 0


def test_what_waited_while_nobody_read():
    inflow = Sending()
    inflow.reading_paused(inflow.now)
    inflow.reading_paused(inflow.now + 1)
    assert inflow.held(inflow.now + 2, has_unread=False) == 2.0
    inflow.now += 3
    inflow.reading_resumed(inflow.now)
    inflow.hear(PAUSE_BEHIND)  # the loop had something else to do, meanwhile
    assert inflow.age(has_unread=True) == 3.0
    inflow.hear(0.001)
    assert inflow.flowing(inflow.now) > 3
    assert inflow.age() == 3.0  # it was the last of it
    assert inflow.age() == 3.0
    inflow.hear(0.001)
    assert inflow.age() == 0


def test_many_short_times_are_a_long_one_until_it_has_caught_up():
    inflow = Sending()
    for _ in range(10):
        inflow.reading_paused(inflow.now)
        inflow.now += 0.1
        inflow.reading_resumed(inflow.now)
        inflow.hear(0.002)
        inflow.age(has_unread=True)
    assert inflow.age(has_unread=True) == pytest.approx(1)


def test_a_moment_in_which_it_was_not_read_leaves_its_pauses_as_they_are():
    """Who sends a large chunk is not read for the rest of the round."""
    inflow = Sending()
    for _ in range(100):
        inflow.now += 0.001
        inflow.reading_paused(inflow.now)
        inflow.now += 0.001
        inflow.reading_resumed(inflow.now)
        inflow.hear(2 * PAUSE)
        assert inflow.flowing(inflow.now) == 0
        inflow.hear(0.001)
        inflow.age()
        inflow.now += 0.001


def test_who_pauses_has_nothing_left_of_before():
    inflow = Sending()
    for _ in range(100):
        inflow.reading_paused(inflow.now)  # for the rest of the round, by a large chunk of its own
        inflow.hear(0, bytes(500))
        assert inflow.flowing(inflow.now) == 0
        inflow.now += 0.01
        inflow.reading_resumed(inflow.now)
        assert inflow.see(unread=True) == PAUSE_BEHIND
        assert inflow.age(has_unread=True) == pytest.approx(0.01)
        inflow.now += PAUSE_BEHIND
        assert inflow.see() == 0
        assert inflow.age() == 0


def test_no_work_of_ours_is_a_pause_of_its_own():
    """There is more of what it has said before than is read in one go."""
    inflow = Sending()
    inflow.reading_paused(inflow.now)
    inflow.now += 1
    inflow.reading_resumed(inflow.now)
    for n in range(9):
        assert inflow.see(unread=True, received=n + 1) == PAUSE_BEHIND
        inflow.hear(3 * PAUSE_BEHIND)
        assert inflow.age(has_unread=True) == 1
    assert inflow.age() == 1
    inflow.hear(3 * PAUSE_BEHIND)
    assert inflow.age() == 0


@pytest.mark.parametrize("round_trip", [0.005, 0.03, 0.1, 1.0])
def test_what_it_kept_back_comes_a_round_trip_after_it_is_read_again(round_trip):
    inflow = Sending()
    inflow.reading_paused(inflow.now)
    inflow.now += 1
    inflow.reading_resumed(inflow.now)
    received = 60_000  # what the system had kept
    pause = inflow.see(unread=True, full=True, received=received, round_trip=round_trip)
    assert pause == PAUSE_BEHIND
    inflow.hear(0, bytes(received))
    assert inflow.age() == 1
    for _ in range(5):  # it is more than fits into one flight
        inflow.now += PAUSE_BEHIND
        inflow.see(received=received, round_trip=round_trip)
        inflow.hear(round_trip, bytes(14_000))
        received += 14_000
        assert inflow.age() == 1
    last, while_nothing = inflow.now, 2 * round_trip + PAUSE_BEHIND
    inflow.now += PAUSE_BEHIND
    received += LITTLE  # who goes on with little has nothing else to say
    while pause := inflow.see(received=received, round_trip=round_trip):
        inflow.hear(pause / 2)
        assert inflow.age() == 1
        inflow.now += pause / 2 + 0.001
    assert while_nothing < inflow.now - last < 3 * while_nothing
    inflow.hear(0)
    assert inflow.age() == 0


def test_who_has_not_caught_up_before_it_is_not_read_again_has_it_all_before_it():
    inflow = Sending()
    for _ in range(3):
        inflow.reading_paused(inflow.now)
        inflow.now += 0.3
        assert inflow.see(full=True) == 0  # nothing to be seen while it is not read
        inflow.reading_resumed(inflow.now)
        inflow.see(unread=True, full=True, round_trip=0.1)
        inflow.hear(0, bytes(60_000))
        inflow.now += 0.1
        assert inflow.see(received=60_000, round_trip=0.1)
    assert inflow.age() == pytest.approx(0.9)


class Streaming(Sending):
    """It says so many bytes each `every` seconds; those are looked at when that is due, and nothing
    is ever left unread."""

    def __init__(self, size, every, round_trip):
        super().__init__()
        self.__dict__.update(size=size, every=every, round_trip=round_trip)
        self.__dict__.update(received=0, looks_at=0.0)

    def pause(self, seconds, *, full=True):
        self.reading_paused(self.now)
        self.now += seconds
        self.reading_resumed(self.now)
        self.look_now(unread=True, full=full)

    def look_now(self, **seen):
        seconds = self.see(received=self.received, round_trip=self.round_trip, **seen)
        self.looks_at = self.now + seconds if seconds else 0.0

    def stream(self, seconds):
        """Returns for how long it was behind."""
        begun, behind = self.now, 0.0
        while self.now < begun + seconds:
            self.received += self.size
            self.hear(self.every, bytes(self.size))
            if self.looks_at and self.looks_at <= self.now:
                self.look_now()
            if self.age():
                behind = self.now - begun
        return behind


@pytest.mark.parametrize(
    ("size", "every", "round_trip", "paused"),
    [
        (3000, 0.005, 0.005, 0.6),
        (8192, 1 / 30, 0.005, 0.6),
        (3000, 0.05, 0.05, 0.6),
        (60_000, 0.03, 0.1, 1.0),
    ],
)
def test_who_streams_on_catches_up(size, every, round_trip, paused):
    inflow = Streaming(size, every, round_trip)
    inflow.pause(paused)
    assert inflow.stream(20) < CATCHING_UP * paused + 20 * round_trip + 0.3
    inflow.pause(paused)
    inflow.received += int(size / every * paused)  # what it had kept back comes at once
    assert inflow.stream(20) < 6 * round_trip + 0.3


def test_pauses_of_ours_in_a_stream_do_not_add_up():
    """Each of its large chunks ends the reading for this round."""
    inflow = Streaming(100_000, 0.03, 0.005)
    inflow.pause(0.6)
    for _ in range(300):
        inflow.pause(0.002, full=False)
        inflow.stream(0.03)
    assert not inflow.is_behind


def test_what_takes_long_to_catch_up_does_so_until_the_end():
    """Its network is hardly faster than it is itself."""
    inflow = Streaming(10_000, 0.01, 0.02)
    inflow.pause(1.0)
    assert CATCHING_UP < inflow.stream(20) < CATCHING_UP + 1


@pytest.mark.parametrize("watched", [False, True])
def test_half_a_frame_is_looked_for_ever_more_rarely(watched):
    inflow = Sending()
    inflow.is_watched = watched
    inflow.reading_paused(inflow.now)
    inflow.now += 0.1
    inflow.reading_resumed(inflow.now)
    looks, begun = 0, inflow.now
    while inflow.now < begun + 60:
        inflow.now += inflow.see(unread=True, received=50)
        looks += 1
    assert looks < 70
    # The rest of it comes, and something asks.
    assert inflow.see(unread=True, received=100) <= 1
    assert inflow.see() == 0
