"""amqtt's plugins: the running broker as an `amqtt.broker.Broker`, around our data path.

This package is imported only when plugins are configured (`broker.plugins`).

Configuration object, life cycle, `BrokerContext` and plugin manager are amqtt's, so plugins written
for it run unchanged. Its listeners, sessions and broadcast loop are not used: `appliance.broker`
does their work. The differences from amqtt's own broker that a plugin can notice:

* MESSAGE_RECEIVED, MESSAGE_BROADCAST and the packet events are fired for network clients only,
  their wills included, and not for what the appliance itself and other plugins publish.
* RETAINED_MESSAGE is fired for all topics but `$SYS`, and never with a `client_id`: messages queued
  for an absent client are in the store.
* PACKET_RECEIVED is fired for CONNECT, without its password, and for PUBLISH, once its topic is
  resolved; not for other packets. PACKET_SENT is never fired.
* The number of pending events is limited; further events are dropped while handlers are too slow.
* Topic plugins that have to wait for something cannot answer at once; see `PluginAccess`.
* A session's `username` is what the client gave, vouched for or not, as in amqtt; its `password`
  is None for users of the users file.
* The protocol handlers of `BrokerContext`'s sessions are None, and so are packet ids of messages.
* A plugin that computes, or waits without `await`, blocks everything. Those of amqtt that do so,
  `FileAuthPlugin` and the LDAP plugins, are called in threads, one call at a time each.
* The plugins' answer to a login is cached (`broker.plugin_answers`): they are not asked again about
  a client that comes back with the same login.
"""

from __future__ import annotations

from appliance.config.plugins import PluginSettingsError
from appliance.plugins.broker import (
    ApplianceBroker,
    FileRules,
    check_plugin_settings,
    configuration,
    plugin_kinds,
)
from appliance.plugins.logins import CachePolicy

__all__ = [
    "ApplianceBroker",
    "CachePolicy",
    "FileRules",
    "PluginSettingsError",
    "check_plugin_settings",
    "configuration",
    "plugin_kinds",
]
