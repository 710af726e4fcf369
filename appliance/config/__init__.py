"""appliance.yaml: parsed, validated as a whole, and turned into typed settings.

All problems are reported at once, each with its file, line and key; nothing is guessed. Sizes and
durations carry their unit, paths are relative to the file, `${NAME}` and `${NAME:-default}` are
replaced by environment variables, and values that look like secrets are masked in output.
"""

from __future__ import annotations

from appliance.config.printing import (
    MASK,
    OPEN_WITH_SECRETS,
    describe,
    is_open_with_secrets,
    mask,
    secrets_in,
    secrets_of,
)
from appliance.config.quantities import (
    Bind,
    about_size,
    format_duration,
    format_size,
    parse_bind,
    parse_duration,
    parse_size,
)
from appliance.config.reading import SEARCH_PATH, ConfigError, find, load, load_control, loads
from appliance.config.settings import (
    ActionRoute,
    BridgeLimitsSection,
    BridgeSection,
    BrokerSection,
    LimitsSection,
    Listener,
    OnSilenceSection,
    ParameterRoute,
    Route,
    ServiceRoute,
    Settings,
    TlsSection,
    TopicRoute,
    UpstreamSection,
)
from appliance.config.urls import ProxyUrl, ServerUrl, parse_proxy
from appliance.config.values import Level

__all__ = [
    "MASK",
    "OPEN_WITH_SECRETS",
    "SEARCH_PATH",
    "ActionRoute",
    "Bind",
    "BridgeLimitsSection",
    "BridgeSection",
    "BrokerSection",
    "ConfigError",
    "Level",
    "LimitsSection",
    "Listener",
    "OnSilenceSection",
    "ParameterRoute",
    "ProxyUrl",
    "Route",
    "ServerUrl",
    "ServiceRoute",
    "Settings",
    "TlsSection",
    "TopicRoute",
    "UpstreamSection",
    "about_size",
    "describe",
    "find",
    "format_duration",
    "format_size",
    "is_open_with_secrets",
    "load",
    "load_control",
    "loads",
    "mask",
    "parse_bind",
    "parse_duration",
    "parse_proxy",
    "parse_size",
    "secrets_in",
    "secrets_of",
]
