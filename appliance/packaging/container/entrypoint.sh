#!/bin/sh
# What a container starts. `run` makes what its first start needs, in the volume at /etc/appliance; all
# other commands are the appliance's, as they are: check, doctor, user add …
#
# APPLIANCE_ROBOT    the robot's name, also in place of the file's; unset: at the first start, the host's
# APPLIANCE_NAMES    at the first start: names that clients dial, for the server's certificate
# ROS_SETUP          a ROS to source; unset: that of the image, if it has one
umask 077

config=/etc/appliance
data=/var/lib/appliance

fail() {
    echo "appliance: $*" >&2
    exit 1
}

# Fail unless there is a volume at folder $1, named $2 in the advice, and this user can write to it. $3
# is what is kept there.
need_volume() {
    mountpoint -q "$1" || fail "no volume is mounted at $1, and $3 would be gone with the" \
        "container. Start it with --volume appliance-configuration:$config" \
        "--volume appliance-data:$data (or, to try it, with --rm --volume $config --volume $data)"
    error=$({ : >"$1/.writable"; } 2>&1) && rm -f "$1/.writable" && return
    case $error in
    *"Read-only"*) fail "the volume at $1 is mounted read-only, and $3 belong there. Start the" \
        "container without :ro behind it" ;;
    *"denied"*) fail "user $(id -u) of this container cannot write to the volume at $1, which belongs" \
        "to user $(stat -c '%u, mode %a' "$1"). On the host, chown -R $(id -u):$(id -g) its folder;" \
        "with SELinux, put :Z behind the volume" ;;
    *) fail "the volume at $1 cannot be written to: ${error##*: }" ;;
    esac
}

first_start() {
    set -f # the names are words, not patterns
    set -- --dir "$config" --data "$data"
    [ -z "$APPLIANCE_ROBOT" ] || set -- "$@" --robot "$APPLIANCE_ROBOT"
    for name in $APPLIANCE_NAMES; do set -- "$@" --name "$name"; done
    # An interrupted one is completed by the next start.
    : >"$config/.first-start" && appliance init "$@" && rm "$config/.first-start"
}

# As the service has it: a ROS that is gone does not keep the broker from its work.
setup=${ROS_SETUP-${ROS_DISTRO:+/opt/ros/$ROS_DISTRO/setup.sh}}
if [ -n "$setup" ] && [ "${setup#/}" = "$setup" ]; then
    echo "appliance: ROS_SETUP has to be the whole path of a file: $setup" >&2
elif [ -f "$setup" ] && [ -r "$setup" ]; then
    # shellcheck disable=SC1090
    . "$setup"
elif [ -n "$setup" ]; then
    echo "appliance: ROS_SETUP cannot be read: $setup" >&2
fi

if [ "$1" = run ]; then
    need_volume "$data" appliance-data "stored messages"
    if [ ! -e "$config/appliance.yaml" ] || [ -e "$config/.first-start" ]; then
        need_volume "$config" appliance-configuration "keys and users"
        first_start || exit
    fi
fi
exec appliance "$@"
