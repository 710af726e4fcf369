"""The systemd unit that runs the appliance, and the file of environment variables beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

NAME = "appliance.service"

#: The user that is made for the service when no other is named.
OWN_USER = "appliance"

CONFIGURATION = Path("/etc/appliance")
DATA = Path("/var/lib/appliance")
ENVIRONMENT = Path("/etc/default/appliance")

#: The release of systemd that knows RestartSteps=, restarting later and later.
KNOWS_STEPS = 254


@dataclass(frozen=True)
class Unit:
    """What differs from one computer to the next.

    `executable` is the command as the service sees it. `single_file` says that it unpacks itself
    and runs in a child process, `behind_home` that it has to read folders of /home or /root.
    """

    executable: Path
    user: str = OWN_USER
    group: str = OWN_USER
    single_file: bool = False
    behind_home: bool = False
    systemd: int = 0

    def __str__(self) -> str:
        steps = "RestartSteps=6\nRestartMaxDelaySec=1min\n" if self.systemd >= KNOWS_STEPS else ""
        return _UNIT.format(
            executable=_escaped(self.executable),
            argument=_escaped(self.executable).replace("$", "$$"),
            user=self.user,
            group=self.group,
            configuration=CONFIGURATION,
            environment=ENVIRONMENT,
            notify_access="all" if self.single_file else "main",
            steps=steps,
            home="read-only" if self.behind_home else "yes",
            ros=_OWN_USER if self.user == OWN_USER else _SAME_USER,
        )


def _escaped(path: Path) -> str:
    return '"' + str(path).replace("%", "%%").replace('"', '\\"') + '"'


_UNIT = """\
# Made by `appliance install`, which replaces it. Changes of your own: systemctl edit appliance
[Unit]
Description=MQTT broker of this robot, with the bridge to ROS
# Not network-online.target: it answers before there is a network, and when there is none.
After=network.target
StartLimitIntervalSec=0

[Service]
Type=notify
SyslogIdentifier=appliance
NotifyAccess={notify_access}
EnvironmentFile=-{environment}
# A ROS that is gone, or not to be read from here, does not keep the broker from its work.
ExecStart=/bin/sh -c 'if [ -r "$$ROS_SETUP" ]; then . "$$ROS_SETUP"; \\
    elif [ -n "$$ROS_SETUP" ]; then echo "<4>ROS_SETUP cannot be read: $$ROS_SETUP" >&2; fi; \\
    exec "$$0" "$$@"' \\
    {argument} run --config {configuration}/appliance.yaml
# Waits for the end of it, and fails with the reason when files cannot be used.
ExecReload={executable} reload --config {configuration}/appliance.yaml
Restart=always
RestartSec=2
{steps}WatchdogSec=20
# A large store takes its time after a power cut.
TimeoutStartSec=5min
TimeoutStopSec=20

User={user}
Group={group}
UMask=0077
WorkingDirectory=/var/lib/appliance
StateDirectory=appliance
StateDirectoryMode=0750
RuntimeDirectory=appliance
# Certificates renew themselves, and password hashes are replaced by better ones.
ReadWritePaths={configuration}
Environment=ROS_LOG_DIR=/tmp/ros
{ros}
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome={home}
# Not PrivateIPC, nor a /dev/shm of its own: ROS nodes exchange data there.
PrivateTmp=yes
PrivateDevices=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
LockPersonality=yes
MemoryDenyWriteExecute=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
# Netlink tells DDS and multicast DNS which network interfaces there are.
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged
SystemCallErrorNumber=EPERM
# A memory image of a crash would have keys and passwords in it.
LimitCORE=0

[Install]
WantedBy=multi-user.target
"""

# DDS prefers shared memory on one computer, and there a program of another user can be found but
# not read: what nodes of root publish would not arrive. Between users it has to be UDP.
_OWN_USER = """\
# Shared memory of DDS works between programs of one user only; `--user` of the nodes' user has it.
Environment=FASTDDS_BUILTIN_TRANSPORTS=UDPv4
RemoveIPC=yes
"""
_SAME_USER = ""

#: What is written to ENVIRONMENT when there is no such file; `{settings}` are lines of variables.
VARIABLES = """\
# Environment variables of the service, read at its start: systemctl restart appliance
# It is root's alone to read: what ${{NAME}} in appliance.yaml stands for may be a password.

# The ROS 2 to use, its own or a workspace's; left out, what the appliance brings along is used.
#ROS_SETUP=/opt/ros/jazzy/setup.sh

# What all nodes of this robot have in common.
#ROS_DOMAIN_ID=0
#ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET
#RMW_IMPLEMENTATION=rmw_fastrtps_cpp
{settings}"""
