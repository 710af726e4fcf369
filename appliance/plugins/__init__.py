"""The running broker as an `amqtt.broker.Broker`: amqtt's frame around our data path.

Configuration object, life cycle, `BrokerContext` and plugin manager are amqtt's, so plugins written
for it run unchanged. Its listeners, sessions and broadcast loop are not used: what they would do,
`appliance.broker` does. What plugins can tell from amqtt's own broker:

* MESSAGE_RECEIVED, MESSAGE_BROADCAST and the packet events are about network clients only, their
  wills included; what the appliance itself and other plugins publish is not told.
* RETAINED_MESSAGE is told for all topics but `$SYS`, and never with a `client_id`: what waits for
  an absent client is the store's business.
* PACKET_RECEIVED is fired for CONNECT, without its password, and for PUBLISH, once its topic was
  looked up; not for other packets. PACKET_SENT is never fired.
* Events wait in a bounded number; what handlers are too slow for is not told to them.
* Topic plugins that have to wait for something cannot answer at once; see `PluginAccess`.
* A session's `username` is what the client gave, vouched for or not, as in amqtt; its `password`
  is None for users of the users file.
* The protocol handlers of `BrokerContext`'s sessions are None, and so are packet ids of messages.
* A plugin that computes, or waits without `await`, stops everything meanwhile. Those of amqtt that
  do, `FileAuthPlugin` and the LDAP ones, are called in threads, each one call after the other.
* What plugins said about a login holds for a while (`broker.plugin_answers`): a client that comes
  back with the same is not asked about again.
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
