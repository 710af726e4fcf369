"""Settings of links, as appliance.yaml has them."""

from __future__ import annotations

from pathlib import Path

from appliance import config
from appliance.upstream.rules import UpstreamSettings
from appliance.upstream.settings import upstreams


def link(keys: str = "", bridge: str = "", robot: str = "r2") -> UpstreamSettings:
    """The link of a robot with these keys beside a name and a server."""
    inside = ", ".join(filter(None, ["name: fleet", "servers: [mqtts://a]", keys]))
    text = f"robot: {robot}\n{bridge}\nupstreams: [{{{inside}}}]"
    return upstreams(config.loads(text, Path("/srv/appliance.yaml"), {}))[0]
