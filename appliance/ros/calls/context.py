"""What the routes of services, actions and parameters share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from appliance.net.callbacks import Entries
from appliance.ros.calls.dispatcher import CallDispatcher
from appliance.ros.calls.requests import Requests
from appliance.ros.node import RosNode
from appliance.ros.payload.converter import Converters


@dataclass(frozen=True, slots=True)
class CallContext:
    """What all calls share.

    `entries` call back on the loop's thread, `post` does so from any thread.
    """

    dispatcher: CallDispatcher
    requests: Requests
    converters: Converters
    node: RosNode
    entries: Entries
    post: Callable[..., None]
