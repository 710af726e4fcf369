"""The options of mosquitto.conf(5), and what becomes of each.

They are those of mosquitto 2.0 and 2.1; `retained_persistence`, `maximum_qos` and a few others are
old names that mosquitto still reads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Scope = Literal["general", "security", "listener", "bridge"]
"""Where an option counts; `security` is general, or of a listener with per_listener_settings."""

Kind = Literal["flag", "number", "word", "text", "secret"]
"""How its value is read: true or false, an integer, one word, the rest of the line; a secret is
such a rest that is never shown. A # in a rest begins no comment, as in mosquitto."""

Fate = Literal["carried", "already", "none"]
"""Carried over; so here anyway; or without a counterpart."""


@dataclass(frozen=True, slots=True)
class Option:
    """An option: `text` says where it is carried to, why it is so already, or what to do instead.

    Nothing is said of the values in `same`, which change nothing here.
    """

    scope: Scope
    kind: Kind
    fate: Fate
    text: str
    same: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()


_ON: Final = ("true", "1")
_OFF: Final = ("false", "0")


def _carried(scope: Scope, kind: Kind, to: str, *choices: str) -> Option:
    return Option(scope, kind, "carried", to, (), choices)


def _already(scope: Scope, kind: Kind, why: str, *choices: str) -> Option:
    return Option(scope, kind, "already", why, (), choices)


def _none(scope: Scope, kind: Kind, text: str, same: tuple[str, ...] = ()) -> Option:
    return Option(scope, kind, "none", text, same)


_PLUGIN: Final = (
    "mosquitto's plugins do not run here, and nobody whom only they know is let in: see amqtt's "
    "plugins for HTTP, SQL, LDAP and JWT (broker.plugins, docs/security.md)"
)
_NO_PSK: Final = "there is no TLS with pre-shared keys: use certificates (docs/certificates.md)"
_ENGINE: Final = "keys are read from PEM files; a key in a TPM or an engine cannot be used"
_LOG: Final = "the log goes to standard error, which systemd's journal keeps and dates"

_GENERAL: Final = {
    "acl_file": _carried("security", "text", "acl.conf"),
    "allow_anonymous": _carried("security", "flag", "broker.anonymous"),
    "allow_duplicate_messages": _none(
        "general", "flag", "what several filters of a client match is sent as MQTT has it", _ON
    ),
    "allow_zero_length_clientid": _none(
        "security", "flag", "clients without an id are given one; none is refused for it", _ON
    ),
    "auth_plugin": _none("security", "text", _PLUGIN),
    "auth_plugin_deny_special_chars": _already(
        "security", "flag", "names with +, # or / match no pattern"
    ),
    "auto_id_prefix": _none("security", "text", "ids that the broker gives cannot be named"),
    "autosave_interval": _already("general", "number", "stored before it is acknowledged"),
    "autosave_on_changes": _already("general", "flag", "stored before it is acknowledged"),
    "check_retain_source": _none(
        "general",
        "flag",
        "a retained message stays when its publisher loses the right to write: remove it with "
        "appliance store prune",
        _OFF,
    ),
    "clientid_prefixes": _carried("general", "text", "client_id_prefixes of each listener"),
    "connection_messages": _none(
        "general", "flag", "connections are always logged at level info", _ON
    ),
    "enable_control_api": _none(
        "general", "flag", "$CONTROL here is that of the appliance (docs/management.md)", _OFF
    ),
    "global_max_clients": _carried("general", "number", "broker.limits.sessions"),
    "global_max_connections": _carried("general", "number", "broker.limits.connections"),
    "global_plugin": _none("security", "text", _PLUGIN),
    "include_dir": _carried("general", "text", "its files are read"),
    "log_dest": _carried("general", "text", "standard error"),
    "log_facility": _none("general", "number", _LOG),
    "log_timestamp": _already("general", "flag", "each line of the log has its time"),
    "log_timestamp_format": _none(
        "general", "text", "the log's times are in UTC, as ISO 8601 (log.format: json for programs)"
    ),
    "log_type": _carried(
        "general",
        "word",
        "log.level",
        *("debug", "error", "warning", "notice", "information", "subscribe", "unsubscribe"),
        *("websockets", "internal", "none", "all"),
    ),
    "max_inflight_bytes": _none(
        "general", "number", "only messages under way are counted (limits.inflight)", ("0",)
    ),
    "max_inflight_messages": _carried("general", "number", "broker.limits.inflight"),
    "max_keepalive": _carried("general", "number", "broker.limits.keep_alive"),
    "max_packet_size": _carried("general", "number", "broker.limits.packet_size"),
    "max_queued_bytes": _carried("general", "number", "broker.limits.queue_bytes"),
    "max_queued_messages": _carried("general", "number", "broker.limits.queue_messages"),
    "memory_limit": _carried("general", "number", "broker.limits.memory"),
    "message_size_limit": _carried("general", "number", "broker.limits.payload_size"),
    "packet_buffer_size": _already("general", "number", "buffers grow as needed"),
    "password_file": _carried("security", "text", "users.passwd"),
    "per_listener_settings": _carried("general", "flag", "anonymous of each listener"),
    "persistence": _carried("general", "flag", "broker.store.durability"),
    "persistence_file": _none(
        "general",
        "text",
        "sessions and retained messages of mosquitto.db are not taken over: let clients publish "
        "retained messages again",
    ),
    "persistence_location": _none(
        "general",
        "text",
        "the appliance has a database of its own (broker.store.path); what mosquitto has stored "
        "stays there",
    ),
    "persistent_client_expiration": _carried("general", "word", "broker.limits.session_expiry"),
    "pid_file": _already("general", "text", "systemd knows the process"),
    "plugin": _none("security", "text", _PLUGIN),
    "plugin_load": _none("security", "text", _PLUGIN),
    "plugin_use": _none("security", "text", _PLUGIN),
    "psk_file": _none("security", "text", _NO_PSK),
    "queue_qos0_messages": _none(
        "general", "flag", "of QoS 0 nothing waits for an absent client: use QoS 1", _OFF
    ),
    "retain_available": _carried("general", "flag", "retain of each listener"),
    "retain_expiry_interval": _none(
        "general",
        "number",
        "a retained message ends by the Message Expiry of its publisher (MQTT 5) alone",
    ),
    "retry_interval": _already("general", "number", "mosquitto reads it no more either"),
    "set_tcp_nodelay": _already("general", "flag", "it always is"),
    "sys_interval": _carried("general", "number", "broker.sys_interval"),
    "upgrade_outgoing_qos": _none(
        "general", "flag", "the QoS of a message is never raised, as MQTT has it", _OFF
    ),
    "user": _already("general", "text", "appliance install makes a user of its own"),
    "websockets_headers_size": _already("general", "number", "headers have a limit of their own"),
    "websockets_log_level": _already("general", "number", "the log has one level"),
}

_LISTENER: Final = {
    "accept_protocol_versions": _carried("listener", "text", "protocol_versions of the listener"),
    "bind_address": _carried("listener", "text", "broker.listeners"),
    "bind_interface": _none(
        "listener",
        "text",
        "a listener is bound to an address: it is on loopback only now; write the interface's "
        "address in its `bind`",
    ),
    "cafile": _carried("listener", "text", "broker.tls.ca"),
    "capath": _none(
        "listener",
        "text",
        "certificates of CAs are in one file: join those of the folder (cat *.pem), and name it as "
        "broker.tls.ca",
    ),
    "certfile": _carried("listener", "text", "broker.tls.certificate"),
    "ciphers": _carried("listener", "text", "ciphers of the listener"),
    "ciphers_tls1.3": _none("listener", "text", "the ciphers of TLS 1.3 are OpenSSL's"),
    "crlfile": _carried("listener", "text", "broker.tls.crl"),
    "dhparamfile": _already("listener", "text", "key exchange is by elliptic curves"),
    "disable_client_cert_date_checks": _none(
        "listener", "flag", "a certificate that has expired is refused", _OFF
    ),
    "enable_proxy_protocol": _none(
        "listener",
        "number",
        "the PROXY protocol is not read: the listener is left out, because who connects through "
        "the proxy would be refused",
    ),
    "http_dir": _none(
        "listener", "text", "no files are served: use a web server, or `protocol: web`"
    ),
    "keyfile": _carried("listener", "text", "broker.tls.key"),
    "listener": _carried("listener", "text", "broker.listeners"),
    "listener_allow_anonymous": _carried("listener", "flag", "anonymous of the listener"),
    "listener_auto_id_prefix": _none(
        "listener", "text", "ids that the broker gives cannot be named"
    ),
    "max_connections": _carried("listener", "number", "broker.limits.connections"),
    "max_qos": _carried("listener", "number", "max_qos of the listener", "0", "1", "2"),
    "maximum_qos": _carried("listener", "number", "max_qos of the listener", "0", "1", "2"),
    "max_topic_alias": _carried("listener", "number", "broker.limits.topic_alias"),
    "max_topic_alias_broker": _none("listener", "number", "the broker uses no aliases", ("0",)),
    "mount_point": _none(
        "listener",
        "text",
        "topics of a listener get no prefix: the listener is left out, because its clients would "
        "meet the others; give its users topics of their own in the ACL",
    ),
    "port": _carried("listener", "number", "broker.listeners"),
    "protocol": _carried(
        "listener", "word", "protocol of the listener", "mqtt", "websockets", "http_api"
    ),
    "proxy_protocol_v2_require_tls": _none("listener", "flag", "the PROXY protocol is not read"),
    "psk_hint": _none("listener", "text", f"{_NO_PSK}; the listener is left out"),
    "require_certificate": _carried("listener", "flag", "client_certificates of the listener"),
    "socket_domain": _carried("listener", "word", "address of the listener", "ipv4", "ipv6"),
    "tls_engine": _none("listener", "text", _ENGINE),
    "tls_engine_kpass_sha1": _none("listener", "secret", _ENGINE),
    "tls_keyform": Option(
        "listener", "word", "none", _ENGINE, same=("pem",), choices=("pem", "engine")
    ),
    "tls_version": _carried(
        "listener", "word", "min_version of the listener", "tlsv1.3", "tlsv1.2", "tlsv1.1", "tlsv1"
    ),
    "use_identity_as_username": _carried("listener", "flag", "broker.tls.username_from"),
    "use_subject_as_username": _none(
        "listener",
        "flag",
        "the listener is left out: a certificate names its user by the common name "
        "(broker.tls.username_from: subject) and not by the whole subject; add the listener with "
        "that, and ACL lines that have the common name",
        _OFF,
    ),
    "use_username_as_clientid": _none(
        "listener",
        "flag",
        "the listener is left out: here a client keeps its id, and rules with %c would be for any "
        "that it chooses; a session belongs to its user anyway, so add the listener where no rule "
        "has %c",
        _OFF,
    ),
    "websockets_origin": _none(
        "listener", "text", "a browser's Origin is not looked at: clients have to log in"
    ),
}

_START: Final = (
    "a link is always up; with start_type lazy mosquitto connects from a number of messages on, "
    "with once it does not come back"
)

_BRIDGE: Final = {
    "address": _carried("bridge", "text", "servers"),
    "addresses": _carried("bridge", "text", "servers"),
    "bridge_alpn": _carried("bridge", "text", "tls.alpn"),
    "bridge_attempt_unsubscribe": _already("bridge", "flag", "old filters are unsubscribed from"),
    "bridge_bind_address": _none("bridge", "text", "the system chooses where a link leaves"),
    "bridge_cafile": _carried("bridge", "text", "tls.ca"),
    "bridge_capath": _none(
        "bridge",
        "text",
        "this computer's own list of authorities is used, or the one file that `tls.ca` of the "
        "link names: join those of the folder where it has others",
        ("/etc/ssl/certs", "/etc/ssl/certs/"),
    ),
    "bridge_certfile": _carried("bridge", "text", "tls.certificate"),
    "bridge_ciphers": _none("bridge", "text", "the ciphers of a link are OpenSSL's"),
    "bridge_ciphers_tls1.3": _none("bridge", "text", "the ciphers of a link are OpenSSL's"),
    "bridge_identity": _none("bridge", "text", f"{_NO_PSK}; the link is left out"),
    "bridge_insecure": _none(
        "bridge",
        "flag",
        "the name in the server's certificate is always checked: if it is another than the host's, "
        "write it as `tls.server_name` of the link",
        _OFF,
    ),
    "bridge_keyfile": _carried("bridge", "text", "tls.key"),
    "bridge_max_packet_size": _none(
        "bridge",
        "number",
        "what the server announces (MQTT 5) or its `kind` allows is kept",
        ("0",),
    ),
    "bridge_max_topic_alias": _already("bridge", "number", "as many as the server allows"),
    "bridge_outgoing_retain": _carried("bridge", "flag", "retain of its rules"),
    "bridge_protocol_version": _carried(
        "bridge", "word", "version", "mqttv31", "mqttv311", "mqttv50"
    ),
    "bridge_psk": _none("bridge", "secret", f"{_NO_PSK}; the link is left out"),
    "bridge_receive_maximum": _none("bridge", "number", "the link sets its own"),
    "bridge_reload_type": _already("bridge", "word", "a changed link connects anew"),
    "bridge_require_ocsp": _none("bridge", "flag", "OCSP is not asked for", _OFF),
    "bridge_session_expiry_interval": _none("bridge", "number", "the link sets its own"),
    "bridge_tcp_keepalive": _already("bridge", "text", "pings notice a dead connection"),
    "bridge_tcp_user_timeout": _already("bridge", "number", "pings notice a dead connection"),
    "bridge_tls_use_os_certs": _carried("bridge", "flag", "TLS with the computer's authorities"),
    "bridge_tls_version": Option(
        "bridge",
        "word",
        "none",
        "TLS is 1.2 or later, whichever the server has",
        same=("tlsv1.2",),
        choices=("tlsv1.3", "tlsv1.2", "tlsv1.1", "tlsv1"),
    ),
    "cleansession": _carried("bridge", "flag", "offline of its rules"),
    "clientid": _carried("bridge", "text", "client_id"),
    "connection": _carried("bridge", "word", "name"),
    "idle_timeout": _already("bridge", "number", "a link is always up"),
    "keepalive_interval": _carried("bridge", "number", "keep_alive"),
    "local_cleansession": _already("bridge", "flag", "what a link sends waits on the disk"),
    "local_clientid": _already("bridge", "text", "a link's ids here are _upstream.NAME"),
    "local_password": _already("bridge", "secret", "a link needs no password here"),
    "local_username": _carried("bridge", "text", "user, with ACL lines of its own"),
    "notification_topic": _none(
        "bridge",
        "text",
        "a link says at its `prefix`_appliance/state there whether it is up, and at "
        "$SYS/broker/connection/ID/state here",
    ),
    "notifications": _carried("bridge", "flag", "$SYS/broker/connection/ID/state, here"),
    "notifications_local_only": _carried("bridge", "flag", "as notifications"),
    "password": _carried("bridge", "secret", "login.password_file"),
    "remote_clientid": _carried("bridge", "text", "client_id"),
    "remote_password": _carried("bridge", "secret", "login.password_file"),
    "remote_username": _carried("bridge", "text", "login.username"),
    "restart_timeout": _already("bridge", "text", "it dials again after 1 s to 45 s"),
    "round_robin": _none(
        "bridge", "flag", "the first server is returned to as soon as it answers", _OFF
    ),
    "start_type": Option(
        "bridge",
        "word",
        "none",
        _START,
        same=("automatic",),
        choices=("automatic", "lazy", "once"),
    ),
    "threshold": _already("bridge", "number", "a link is always up"),
    "topic": _carried("bridge", "text", "rules of `out` and `in`"),
    "try_private": _already("bridge", "flag", "No Local (MQTT 5) ends loops"),
    "username": _carried("bridge", "text", "login.username"),
}

#: Every option, by its name.
OPTIONS: Final = {
    **_GENERAL,
    **_LISTENER,
    **_BRIDGE,
    "retained_persistence": _GENERAL["persistence"],
}

#: Options of plugins are named by the plugins.
PLUGIN_PREFIXES: Final = ("auth_opt_", "plugin_opt_")
PLUGIN_OPTION: Final = Option("security", "secret", "already", "goes with its plugin")

#: Where one of these is, a plugin has a say in who may do what.
PLUGINS: Final = ("auth_plugin", "plugin", "global_plugin", "plugin_load", "plugin_use")


def option_of(name: str) -> Option | None:
    """The option of that name; None when mosquitto has none."""
    if name.startswith(PLUGIN_PREFIXES):
        return PLUGIN_OPTION
    return OPTIONS.get(name)
