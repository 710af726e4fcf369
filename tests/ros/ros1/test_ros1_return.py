"""Nodes and Masters of ROS 1 that go and come back. These tests leave a Master behind that does not
know the robot."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
from contextlib import ExitStack
from functools import partial
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

import psutil
import pytest
from ros1_world import Mqtt, Node, Python, Ros1Appliance, Run, World, end, is_installed, output
from waiting import eventually

from appliance.ros.node import BusError
from appliance.ros.ros1.node import POLL_INTERVAL
from appliance.ros.ros1.peers import fetch_definition

pytestmark = pytest.mark.skipif(
    not is_installed(), reason="needs ROS 1: apt install python3-roslaunch python3-rospy …"
)


def ports(process: psutil.Process) -> set[int]:
    return {
        found.laddr.port
        for found in process.net_connections("inet")
        if found.status == psutil.CONN_LISTEN
    }


def is_used(port: int, process: psutil.Process) -> bool:
    """Whether somebody still listens at a port, or the process has connections there."""
    with socket.socket() as probe:
        if probe.connect_ex(("127.0.0.1", port)) == 0:
            return True
    return any(found.laddr.port == port for found in process.net_connections("inet"))


def test_a_silent_peer_does_not_block_others(
    world: World, robot: Node, appliance: Ros1Appliance
) -> None:
    with Mqtt(appliance) as client, ExitStack() as silent:
        for port in ports(psutil.Process(appliance.pid)):
            silent.enter_context(socket.create_connection(("127.0.0.1", port)))
        echo = world.begin("rostopic", "echo", "-n", "1", "/hear")
        try:
            greet = partial(client.paho.publish, "r2d2/hear", '{"data": "hello"}')
            assert "hello" in output(echo, greet)
        finally:
            if echo.poll() is None:
                end(echo)


@pytest.mark.parametrize(
    "address", ["rosrpc://127.0.0.1:99999", "rosrpc://[x", f"rosrpc://{'a' * 80}:80", "rosrpc://"]
)
def test_a_service_with_a_malformed_address_is_skipped(
    world: World, robot: Node, appliance: Ros1Appliance, address: str
) -> None:
    before = appliance.log.count("there is no bridge to ROS")
    with ServerProxy(world.environment["ROS_MASTER_URI"]) as master, Mqtt(appliance) as client:
        assert master.registerService("/bad", "/robot/bad", address, "http://127.0.0.1:1/")[0] == 1  # type: ignore[index]
        try:
            time.sleep(4 * POLL_INTERVAL)
            assert client.call("r2d2/robot/switch", {"data": True})
        finally:
            master.unregisterService("/bad", "/robot/bad", address)
    assert appliance.log.count("there is no bridge to ROS") == before


@pytest.mark.parametrize("port", ["abc", -1, "9" * 30, [80], ""])
def test_a_publisher_with_a_malformed_port_is_skipped(port: object) -> None:
    def told(*_: object) -> object:
        return [1, "", ["TCPROS", "127.0.0.1", port]]

    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False) as server:
        uri = f"http://127.0.0.1:{server.server_address[1]}"
        server.register_function(lambda *_: [1, "", uri], "lookupNode")
        server.register_function(told, "requestTopic")
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            with pytest.raises(BusError, match="/other cannot be reached"):
                fetch_definition(uri, "/me", "/other", "/odd")
        finally:
            server.shutdown()
            thread.join()


def test_the_node_joins_again_once_its_name_is_free(
    world: World, robot: Node, appliance: Ros1Appliance
) -> None:
    process = psutil.Process(appliance.pid)
    before_ports = ports(process)
    joined, offered = "on ROS as /appliance", "/robot/switch can be called"
    before = {text: appliance.log.count(text) for text in (joined, offered)}
    silent = [socket.create_connection(("127.0.0.1", port)) for port in before_ports]
    # The Master lets another node take the name.
    other = world.begin("rostopic", "echo", "/none", "__name:=appliance")
    try:
        appliance.wait_for_log("there is no bridge to ROS: /appliance was shut down from outside")
        appliance.wait_for_log("another node, at http://127.0.0.1:.*, is called /appliance")
        assert other.poll() is None
    finally:
        end(other)
    for text, count in before.items():
        appliance.wait_for_log(text, count + 1)
    with Mqtt(appliance, "r2d2/many") as client:
        answer = client.call("r2d2/robot/switch", {"data": True})
        assert answer == {"success": False, "message": "so"}
        robot.do("publish", "/many", "std_msgs/String", "again")
        client.next("r2d2/many", {"data": "again"})
    # Nothing is left of the node that was: its servers, the connections to them, their threads.
    left = before_ports - ports(process)
    assert len(left) == 2, "that of XML-RPC, and that of TCPROS"
    for port in left:
        eventually(lambda port=port: not is_used(port, process), f"port {port} is free")  # type: ignore[misc]
    for caller in silent:
        caller.close()


JOIN_AGAIN = """\
import gc, types
from importlib import import_module
from appliance.ros.ros1.endpoints import message_class
from appliance.ros.ros1.rospy_cleanup import unload
from appliance.ros.ros1.types import installed
for _ in range(3):
    unload()
    message_class(import_module("rospy"), installed("std_msgs/msg/String"))
gc.collect()
modules = [each for each in gc.get_objects() if isinstance(each, types.ModuleType)]
print([each.__name__ for each in modules].count("rospy.core"))
"""


def test_an_unloaded_rospy_does_not_stay_in_memory(world: World, python: Python) -> None:
    environment = {**world.environment, "PYTHONPATH": python.path, "LD_LIBRARY_PATH": ""}
    command = [python.executable, "-c", JOIN_AGAIN]
    assert int(subprocess.check_output(command, env={**os.environ, **environment})) == 1


def test_a_master_that_is_killed_and_comes_back(
    world: World, robot: Node, appliance: Ros1Appliance, run: Run
) -> None:
    with Mqtt(appliance, "r2d2/many", "r2d2/chatter", "r2d2/_appliance/state") as client:
        robot.do("publish", "/many", "std_msgs/String", "before")
        client.next("r2d2/many", {"data": "before"})
        world.kill()
        appliance.wait_for_log("the ROS Master does not answer")
        # Nodes that know each other need no Master.
        robot.do("publish", "/many", "std_msgs/String", "meanwhile")
        client.next("r2d2/many", {"data": "meanwhile"})
        assert client.call("r2d2/robot/switch", {"data": True})["error"]  # type: ignore[index]
        assert "ROS: the ROS Master does not answer: http://" in run("status")[1]
        world.start()
        appliance.wait_for_log("the ROS Master is back")
        appliance.wait_for_log("registered again with the ROS Master")
        publishers, subscribers, services = world.graph()
        assert "/appliance" in publishers["/hear"] and "/appliance" in subscribers["/many"]
        assert "/appliance" in services["/ask_human"]
        # A node that comes only now: both ways, a service, and the old robot's still.
        talker = world.begin(
            "rostopic", "pub", "-r", "10", "/chatter", "std_msgs/String", "data: again"
        )
        echo = world.begin("rostopic", "echo", "-n", "1", "/hear")
        try:
            client.next("r2d2/chatter", {"data": "again"})
            greet = partial(client.paho.publish, "r2d2/hear", '{"data": "hello again"}')
            assert "hello again" in output(echo, greet)
        finally:
            for process in (talker, echo):
                if process.poll() is None:
                    end(process)
        said = world.run("rosservice", "call", "/ask_human", "true")
        assert "nobody" in said
        robot.do("publish", "/many", "std_msgs/String", "after")
        client.next("r2d2/many", {"data": "after"})
        state = client.next("r2d2/_appliance/state", ...)
        assert state.payload == b"online"
