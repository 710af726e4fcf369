"""The links to fleets' brokers that run: those of appliance.yaml, also after a reload."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from appliance.broker.backlogs import Backlogs
from appliance.broker.broker import Broker
from appliance.config import Settings
from appliance.net.callbacks import Entries
from appliance.net.layers import LayerScheduler

if TYPE_CHECKING:
    from appliance.upstream.rules import UpstreamSettings
    from appliance.upstream.uplink import Uplink


class Links:
    """Starts, replaces and stops links; what waits for one stays in the store, by its name."""

    def __init__(
        self, broker: Broker, entries: Entries, backlogs: Backlogs, scheduler: LayerScheduler
    ) -> None:
        #: Those that run, in the order of the file.
        self.running: list[Uplink] = []
        #: Others, for which something is stored: they were removed, or have another name now.
        self.left_behind: list[str] = []
        self._broker = broker
        self._entries = entries
        self._backlogs = backlogs
        self._scheduler = scheduler
        self._is_stopped = False

    def start(self, settings: Settings) -> None:
        """Connect in the background."""
        for link in _wanted(settings):
            self._start(link)
        self._find_left_behind()

    async def replace(self, settings: Settings) -> list[str]:
        """End the links that are not there any more, or are different, and start those of the
        settings; returns a list of what has changed."""
        wanted = {link.name: link for link in _wanted(settings)}
        changed: list[str] = []
        for uplink in list(self.running):
            link = wanted.get(uplink.settings.name)
            if link == uplink.settings or self._is_stopped:
                continue
            # It takes what is published until it has ended, and the next one begins at once:
            # nothing is published between them.
            client_id = uplink.settings.client_id
            is_named = any(each.client_id == client_id for each in wanted.values())
            await uplink.stop(is_last=link is None, is_named=is_named)
            self.running.remove(uplink)
            changed.append(f"{uplink} is {'removed' if link is None else 'started anew'}")
            if link is not None:
                self._start_contained(link, uplink)
        running = {uplink.settings.name for uplink in self.running}
        for name, link in wanted.items():
            if name not in running:
                self._start_contained(link)
                changed.append(f"upstream '{name}' is new")
        if not self._is_stopped:  # else there may be others than the wanted ones
            order = list(wanted)
            self.running.sort(key=lambda uplink: order.index(uplink.settings.name))
        self._find_left_behind()
        return changed

    def _find_left_behind(self) -> None:
        """Only the start and the end of a link change it: what it takes time to find is kept."""
        running = {uplink.settings.name for uplink in self.running}
        self.left_behind = [name for name in self._backlogs.waiting_links() if name not in running]

    def _start_contained(self, link: UpstreamSettings, before: Uplink | None = None) -> None:
        """A fault of one link keeps no other one from its start."""
        self._entries.run("upstream.start", link.name, None, self._start, (link, before))

    def _start(self, link: UpstreamSettings, before: Uplink | None = None) -> None:
        from appliance.upstream.uplink import Uplink, UplinkParts

        if self._is_stopped:
            return
        parts = UplinkParts(self._broker, self._entries, self._backlogs, self._scheduler)
        uplink = Uplink(link, parts, before)
        uplink.start()
        self.running.append(uplink)

    async def stop(self) -> None:
        """End all of them; may be called twice."""
        if not self._is_stopped:
            self._is_stopped = True
            async with contextlib.AsyncExitStack() as stack:
                for uplink in self.running:
                    stack.push_async_callback(uplink.stop)


def _wanted(settings: Settings) -> list[UpstreamSettings]:
    if not settings.upstreams:
        return []  # what is imported here takes a tenth of a second
    from appliance.upstream.settings import upstreams

    return upstreams(settings)
