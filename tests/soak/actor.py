"""Who the clients of the soak are, and what comes to their minds; all of it follows from a seed."""

from __future__ import annotations

import asyncio
import random
from dataclasses import dataclass

from appliance.mqtt.codec import V5, V311
from appliance.mqtt.packets import Pingreq, Subscribe, Subscription
from soak.client import Client
from soak.model import Model
from soak.rights import SHARE, Rights
from soak.wire import Profile, Target

_ROOT = "r2d2/soak"
_POOL = "r2d2/pool"

RIGHTS = {
    "open": Rights((f"{_ROOT}/#", f"{_POOL}/#"), (f"{_ROOT}/#", f"{_POOL}/#")),
    "fenced": Rights(
        (f"{_ROOT}/#", f"{_POOL}/#"), (f"{_ROOT}/#", f"{_POOL}/#"), (f"{_ROOT}/secret/#",)
    ),
    "reader": Rights((f"{_ROOT}/#", f"{_POOL}/#"), ()),
    "observer": Rights(("$SYS/#",), ()),
}

#: The moments in the protocol at which a connection may be cut; see `Client.trap`.
_TRAPS = (
    *("PUBLISH 0 sent", "PUBLISH 1 sent", "PUBLISH 2 sent", "SUBSCRIBE sent"),
    *("PUBREC received", "PUBREL sent"),
    *("PUBLISH 1 received", "PUBACK sent"),
    *("PUBLISH 2 received", "PUBREC sent", "PUBREL received", "PUBCOMP sent"),
)

#: Seconds that a connection is used, on average.
_STAY = 8.0

#: Seconds that a brief session is kept.
_BRIEF = 2

#: Messages that are published at once now and then, and how rarely.
_BURST = 15
_BURST_EVERY = 40

#: Filters that a client subscribes to.
_FILTERS = 4

#: Groups of shared subscriptions and their QoS, and how large a part of all traffic they have.
_GROUPS = {"two": 2, "one": 1, "nought": 0}
_GROUP_WEIGHTS = (6, 3, 1)


@dataclass(frozen=True)
class Crowd:
    """What is common to all clients."""

    seed: int
    clients: int
    #: Messages that a client publishes a second, on average.
    rate: float
    #: Shared subscriptions are used, too.
    shared: bool

    @property
    def groups(self) -> int:
        """Publishers are in as many groups as keep a group's filter at a few messages a second."""
        return max(2, self.clients // 4)


class Actor:
    """One client and its habits."""

    def __init__(self, crowd: Crowd, model: Model, target: Target, number: int) -> None:
        self.crowd = crowd
        self.number = number
        self.name = f"c{number:03}"
        self.random = random.Random(f"{crowd.seed}/{number}")
        self.member_of = self._group()
        self.client = Client(model, target, self._profile(), f"{crowd.seed}/{number}/client")
        self.stopping = False
        #: What the client wants to be subscribed to, and with which QoS.
        self.wanted: dict[str, int] = {}
        self._retains = self.random.choice((1, 2))
        self._is_slow = self.random.random() < 0.2
        self._will_qos = self.random.choice((None, 0, 1, 2))
        self._areas = ["a", "a", "a", "b", "b", "secret", "kept"]
        if crowd.shared:
            self._areas += ["pool"]
        if self.member_of is not None:
            self.wanted[f"{SHARE}{self.member_of}/{_POOL}/{self.member_of}/#"] = _GROUPS[
                self.member_of
            ]
        while len(self.wanted) < _FILTERS:
            self.wanted[self._filter()] = self.random.choice((0, 1, 1, 2, 2))

    def _group(self) -> str | None:
        if not self.crowd.shared or self.random.random() < 0.85:
            return None
        return self.random.choices(list(_GROUPS), _GROUP_WEIGHTS)[0]

    def _profile(self) -> Profile:
        dice = self.random
        version = V5 if dice.random() < 0.5 else V311
        user = dice.choices(("open", "fenced", "reader"), (70, 20, 10))[0]
        expiry = dice.choice((0, 3600, 3600, _BRIEF)) if version == V5 else dice.choice((0, 604800))
        if self.member_of is not None:
            # A member's session never ends, else what it was chosen for would be void.
            version, expiry = V5, 3600
        v5 = version == V5
        return Profile(
            client_id=self.name,
            user=user,
            version=version,
            tls=dice.random() < 0.5,
            expiry=expiry,
            receive_maximum=dice.choice((65535, 65535, 20, 5, 1)) if v5 else 65535,
            aliases=dice.choice((0, 3)) if v5 else 0,
            ack_delay=dice.choice((0, 0, 0, 0.005, 0.05)),
            as_published=v5 and dice.random() < 0.2,
            declines=0.02 if v5 and dice.random() < 0.2 else 0.0,
            receive_buffer=4096 if dice.random() < 0.2 else 0,
        )

    def _filter(self) -> str:
        """A filter as robots' users write them: most are narrow, few are wide."""
        dice = self.random
        crowd = self.crowd
        other = f"c{dice.randrange(crowd.clients):03}"
        group = dice.randrange(crowd.groups)
        area = dice.choice(("a", "a", "b", "secret"))
        profile = self.client.profile
        # Who takes a few messages a second only must not be sent hundreds.
        wide = not profile.ack_delay or profile.receive_maximum >= 20
        return dice.choices(
            (
                f"{_ROOT}/{area}/{group}/{other}",
                f"{_ROOT}/+/+/{other}",
                f"{_ROOT}/{area}/{group}/+",
                f"{_ROOT}/{area}/{group}/#",
                f"+/soak/+/{group}/+",
                f"{_ROOT}/kept/+/{other}",
                f"{_ROOT}/kept/#",
                f"{_ROOT}/will/+",
                f"{_ROOT}/secret/#",
                f"{_ROOT}/#",
            ),
            (100, 140, 80, 60, 60, 60, *((3, 10, 4, 1) if wide else (0, 0, 0, 0))),
        )[0]

    def _topic(self) -> tuple[str, int, bool]:
        """Where it publishes next: topic, QoS, retained."""
        dice = self.random
        area = dice.choice(self._areas)
        if area == "kept":
            return f"{_ROOT}/kept/{self._retains}/{self.name}", self._retains, True
        qos = dice.choice((0, 1, 1, 2, 2))
        if area == "pool":
            group = dice.choices(list(_GROUPS), _GROUP_WEIGHTS)[0]
            return f"{_POOL}/{group}/{self.name}", qos, False
        place = (self.number, self.number * 7 + 3)[dice.randrange(2)] % self.crowd.groups
        return f"{_ROOT}/{area}/{place}/{self.name}", qos, False

    # --- a life --------------------------------------------------------------------------------

    async def run(self) -> None:
        """Come, be there and go, until `stopping`."""
        dice = self.random
        await asyncio.sleep(dice.uniform(0, 1 + self.crowd.clients / 50))
        while not self.stopping:
            if await self._arrive():
                await self._stay()
                if not self.stopping:
                    await self._go()

    async def _arrive(self) -> bool:
        dice = self.random
        profile = self.client.profile
        clean = profile.expiry == 0 and (profile.version == V311 or dice.random() < 0.5)
        stop = dice.choices((None, "open", "half", "sent"), (92, 2, 2, 4))[0]
        if self.member_of is None:
            clean = clean or dice.random() < 0.05
        elif stop == "sent" and self.client.session is None:
            stop = None
        if not await self.client.connect(clean=clean, will_qos=self._will_qos, stop=stop):
            await asyncio.sleep(dice.choice((0, 0, 0.5)))
            return False
        self._restore()
        return True

    def _restore(self) -> None:
        """Subscribe to what the session has not, as far as known."""
        client = self.client
        assert client.session is not None
        missing = {
            name: qos
            for name, qos in self.wanted.items()
            if not client.model.holds(client.session, name)
        }
        if missing:
            client.outbox.subscribe(missing)

    async def _stay(self) -> None:
        dice = self.random
        client = self.client
        loop = asyncio.get_running_loop()
        leave_at = loop.time() + dice.expovariate(1 / _STAY)
        if dice.random() < 0.6:
            client.trap = dice.choice(_TRAPS)
        deeds = {
            self._publish: self.crowd.rate / (1 + _BURST / _BURST_EVERY),
            self._ping: 0.3,
            self._change: 0.1,
            self._pause: 0.1 if self._is_slow else 0.0,
        }
        pace = sum(deeds.values())
        while client.wire is not None and not self.stopping:
            pause = min(dice.expovariate(pace), leave_at - loop.time())
            if pause <= 0:
                return
            try:
                await asyncio.wait_for(client.gone.wait(), pause)
            except asyncio.TimeoutError:
                deed = dice.choices(list(deeds), list(deeds.values()))[0]
                if client.wire is not None:  # cut at the same moment
                    deed()

    def _publish(self) -> None:
        dice = self.random
        topic, qos, retain = self._topic()
        size = dice.choices((0, 200, 2000, 40_000), (60, 30, 9, 1))[0]
        clears = retain and dice.random() < 0.03
        self.client.outbox.publish(topic, qos, retain=retain, size=size, clears=clears)
        if not dice.randrange(_BURST_EVERY):
            for _ in range(_BURST):
                if self.client.wire is not None:
                    self.client.outbox.publish(topic, qos, retain=retain)

    def _ping(self) -> None:
        self.client.ping()

    def _change(self) -> None:
        """Another filter in place of one, or another QoS for it."""
        dice = self.random
        client = self.client
        assert client.session is not None
        mine = [name for name in self.wanted if not name.startswith(SHARE)]
        changed = dice.choice(mine)
        if dice.random() < 0.4:
            self.wanted[changed] = dice.choice((0, 1, 2))
            client.outbox.subscribe({changed: self.wanted[changed]})
            return
        del self.wanted[changed]
        if changed in client.session.coverages:
            client.outbox.unsubscribe(changed)
        new = self._filter()
        self.wanted[new] = dice.choice((0, 1, 2))
        if dice.random() < 0.5:  # else at the next connection
            client.outbox.subscribe({new: self.wanted[new]})

    def _pause(self) -> None:
        wire = self.client.wire
        assert wire is not None
        wire.pause()
        self.client.model.counts["pauses"] += 1
        asyncio.get_running_loop().call_later(self.random.uniform(0.2, 3), wire.resume)

    async def _go(self) -> None:
        dice = self.random
        client = self.client
        if client.wire is not None:
            how = dice.choices(
                ("cut", "inside", "inside PUBLISH", "DISCONNECT", "take over"), (35, 8, 12, 20, 25)
            )[0]
            if how == "take over":
                return
            if how == "cut":
                client.cut("cuts", reset=dice.random() < 0.6)
            elif how == "inside":
                hollow = Subscribe(65535, [Subscription(f"{_ROOT}/#")])
                client.cut_inside(dice.choice((Pingreq(), hollow)))
                await client.gone.wait()
            elif how == "inside PUBLISH":
                topic, qos, retain = self._topic()
                client.outbox.publish(
                    topic, qos, retain=retain, size=dice.choice((0, 5000)), half=True
                )
                if client.wire is not None:
                    await asyncio.sleep(0.01)
            else:
                ends = self.member_of is None and dice.random() < 0.1
                await client.disconnect(expiry=0 if ends else None, with_will=dice.random() < 0.2)
        pauses = (0, 0, dice.uniform(0, 2), dice.uniform(0, 5))
        pause = dice.choice(pauses)
        if client.profile.expiry == _BRIEF and dice.random() < 0.3:
            pause = _BRIEF + 7
        await asyncio.sleep(pause)

    # --- the end -------------------------------------------------------------------------------

    async def settle(self) -> None:
        """Be connected, and stay, so that what is owed can come."""
        client = self.client
        client.trap = None
        if client.wire is None:
            clean = client.profile.version == V311 and not client.profile.expiry
            await client.connect(clean=clean, will_qos=None)
        if client.wire is not None:
            client.wire.resume()
            client.ping()

    async def vanish(self) -> None:
        """Leave nothing behind: no retained message, and no session."""
        client = self.client
        if client.wire is None:
            return
        await client.disconnect(expiry=0)
        if await client.connect(clean=True, will_qos=None):
            client.outbox.publish(
                f"{_ROOT}/kept/{self._retains}/{self.name}", 1, retain=True, clears=True
            )
            for _ in range(100):
                if client.outbox.empty:
                    break
                await asyncio.sleep(0.1)
            await client.disconnect(expiry=0)
