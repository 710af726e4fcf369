"""Checks the settings of plugins, with the plugins' own checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from appliance.ops.finding import Finding
from appliance.plugins import PluginSettingsError, check_plugin_settings


def plugin_settings(path: str, settings: Mapping[str, Any]) -> Finding:
    """A finding about the settings of a plugin that is installed."""
    try:
        check_plugin_settings(path, settings)
    except PluginSettingsError as error:
        return Finding("error", f"plugin {path}", str(error))
    return Finding("ok", f"plugin {path}", "found, and takes its settings")
