"""What the appliance says of itself, retained below `{robot}/_appliance/`, after a restart."""

from __future__ import annotations

from appliance.broker.retained import RetainedMessages
from appliance.config import Settings
from appliance.ros.home_assistant import FILTER, shown_by


def orphaned_topics(retained: RetainedMessages, settings: Settings) -> list[str]:
    """Topics at which an earlier run has said what no part of this one would take back.

    They are of links that were removed meanwhile, of a bridge where there is none any more (also
    what it has told Home Assistant), and of a robot that had another name. What a user has retained
    at such a topic stays.
    """
    own = f"{settings.robot}/_appliance/"
    links = f"{own}upstream/"
    said = {f"{own}state", *(links + link.name for link in settings.upstreams)}
    has_bridge = settings.bridge.bus != "none"

    def is_said(topic: str) -> bool:
        is_of_bridge = topic.startswith(own) and not topic.startswith(links)
        return topic in said or (has_bridge and is_of_bridge)

    orphaned = [
        topic
        for topic, _ in retained.find("+/_appliance/#")
        if retained.owner(topic).is_inside and not is_said(topic)
    ]
    if not has_bridge:  # which else deletes those that are not its own
        orphaned += [
            topic
            for topic, message in retained.find(FILTER)
            if retained.owner(topic).is_inside and shown_by(message) is not None
        ]
    return orphaned
