"""What can be wrong with `broker.plugins`.

It is here and not in `appliance.plugins` because that is imported only when plugins are configured.
"""

from __future__ import annotations


class PluginSettingsError(ValueError):
    """A plugin named in `broker.plugins` cannot be loaded, or not with these settings."""
