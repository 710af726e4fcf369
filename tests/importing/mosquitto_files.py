"""Configurations of mosquitto as people have them: shapes that are often found, reworded."""

from __future__ import annotations

from pathlib import Path

#: By name: the file, and what it has beside it. Some name what is in a container.
SHAPES: dict[str, tuple[str, dict[str, str]]] = {
    "container_open": (
        "persistence true\npersistence_location /mosquitto/data/\n\nlistener 1883\n\n"
        "allow_anonymous true\n\nlog_dest file /mosquitto/log/mosquitto.log\nlog_dest stdout\n",
        {},
    ),
    "container_users": (
        "listener 1883\nlistener 9001\nprotocol websockets\n\n\n"
        "allow_anonymous false\npassword_file /mosquitto/config/passwd",
        {"passwd": ""},
    ),
    "users_without_file": (
        "listener 1883\nallow_anonymous false\npassword_file /mosquitto/passwords\n",
        {},
    ),
    "local": ("listener 1884 127.0.0.1\nallow_anonymous true\nautosave_interval 1800\n", {}),
    "addresses": (
        "listener 1883 127.0.0.1\nprotocol mqtt\nsocket_domain ipv4\n\n"
        "listener 9001 127.0.0.1\nprotocol websockets\nsocket_domain ipv4\nallow_anonymous true\n",
        {},
    ),
    "old_port": (
        "port 1883\nprotocol mqtt\n#cafile /etc/mosquitto/certs/ca.crt\n\n"
        "listener 9001\nprotocol websockets\nlog_type error\nlog_type warning\nlog_type notice\n",
        {},
    ),
    "old_address": ("bind_address 192.0.2.5\nport 1884\nallow_anonymous true\n", {}),
    "plugin": (
        "allow_anonymous false\n\nlistener 1883\n\nauth_plugin /opt/go-auth.so\n"
        "auth_opt_backends http\nauth_opt_http_host 127.0.0.1\nauth_opt_http_port 8000\n"
        "auth_opt_mysql_password not to be shown\n",
        {},
    ),
    "three_listeners": (
        "max_inflight_messages 20\nmax_queued_messages 100\npersistent_client_expiration 14d\n"
        "listener 1883\nallow_anonymous true\nlistener 8883\nprotocol mqtt\n"
        "cafile /mosquitto/certs/ca.crt\ncertfile /mosquitto/certs/server.crt\n"
        "keyfile /mosquitto/certs/server.key\nrequire_certificate true\n"
        "use_identity_as_username true\nlistener 9001\nprotocol websockets\n",
        {},
    ),
    "windows_paths": (
        "allow_anonymous true\r\nlistener 8883\r\ncafile certificates\\ca.crt\r\n"
        "certfile certificates\\server.crt\r\nkeyfile certificates\\server.key\r\n"
        "tls_version tlsv1.2\r\nrequire_certificate false\r\nlog_type all",
        {},
    ),
    "subjects": (
        "per_listener_settings true\nlistener 8883 0.0.0.0\nallow_anonymous false\n"
        "require_certificate true\nuse_subject_as_username true\ncapath /etc/certs/ca.d\n"
        "certfile /etc/certs/server.crt\nkeyfile /etc/certs/server.key\nacl_file devices.acl\n\n"
        "listener 1883 127.0.0.1\nallow_anonymous true\nlog_dest topic\nsys_interval 10\n",
        {"devices.acl": "pattern readwrite devices/%u/#\n"},
    ),
    "http_api": (
        "password_file passwdfile\n\nlistener 4040 0.0.0.0\n\nlistener 8080 0.0.0.0\n"
        "protocol http_api\nhttp_dir www\n\nenable_control_api true\n"
        "persistence_location storage\n",
        {"passwdfile": "root:$7$too-short\n"},
    ),
    "backend": (
        "pid_file /run/x.pid\nper_listener_settings true\nset_tcp_nodelay true\n"
        "listener 1883 0.0.0.0\nprotocol mqtt\nmax_qos 1\npersistence false\n"
        "retain_available false\nallow_anonymous false\nacl_file /etc/b/acl\npassword_file users\n",
        {"acl": "pattern   read   priv/%c/#\n\nuser b\n\ntopic   readwrite   req/#\n", "users": ""},
    ),
    "edge_bridge": (
        "listener 1883\nallow_anonymous true\nmax_queued_messages 0   # no limit\n"
        "max_queued_bytes 1073741824  # 1 GB\n\nconnection to-server\naddress server:1883\n"
        "topic messages out 1            # queued while it is away\n"
        "bridge_protocol_version mqttv50\ncleansession false  # keep it\ntry_private true\n"
        "notifications true\nrestart_timeout 10\n",
        {},
    ),
    "cloud_bridge": (
        "listener 1883\nallow_anonymous true\nconnection aws\nlog_type all\n"
        "address x-ats.iot.eu-central-1.amazonaws.com:8883\n"
        'topic # out 0 "" $aws/things/robot/shadow/name/\nbridge_protocol_version mqttv311\n'
        "bridge_insecure false\ncleansession true\nclientid robot-7\nstart_type automatic\n"
        "notifications false\nbridge_cafile /etc/certs/root.pem\n"
        "bridge_certfile /etc/certs/robot.crt\nbridge_keyfile /etc/certs/robot.key\n",
        {},
    ),
    "gateway_bridge": (
        "listener 1883\nconnection central\naddress central.example:8883\n"
        "bridge_cafile /etc/ca.crt\ntopic spBv1.0/cell/# both 0\ntopic spBv1.0/# in 0\n"
        'topic iot-2/type/+/cmd/# in "" ""\n'
        "notification_topic STATE/cell\nlocal_password not, to} be shown\nlocal_username cell 1\n"
        "remote_password not} to be shown\nremote_username cell 1\nround_robin false\n",
        {},
    ),
}


def write(name: str, directory: Path) -> Path:
    """Write the files of that shape; returns mosquitto.conf."""
    text, files = SHAPES[name]
    for file, content in files.items():
        (directory / file).write_text(content)
    path = directory / "mosquitto.conf"
    path.write_text(text, newline="")
    return path
