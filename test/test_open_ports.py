# SPDX-License-Identifier: Apache-2.0
"""What a node in this environment listens on: nothing that another machine could reach."""

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from galen_ros.node.spin import DomainLock

ENV = Path(__file__).resolve().parent.parent / "scripts" / "env.sh"
NODE = """
import sys
import rclpy
rclpy.init()
node = rclpy.create_node("listens")
print("up", flush=True)
sys.stdin.read()
"""


def addresses(domain_id, **variables):
    """Addresses of the ports of a domain's DDS in a process that has sourced env.sh."""
    clean = {name: text for name, text in os.environ.items() if name not in ASKED}
    with subprocess.Popen(
        ["bash", "-c", f'source "{ENV}" && exec "{sys.executable}" -c \'{NODE}\''],
        env=clean | {"ROS_DOMAIN_ID": str(domain_id)} | variables,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout.readline() == "up\n"
            ports = range(7400 + 250 * domain_id, 7400 + 250 * (domain_id + 1))
            bound = psutil.Process(process.pid).net_connections("inet")
        finally:
            process.communicate("")
    assert not [one for one in bound if one.status == psutil.CONN_LISTEN], "a TCP port is open"
    return {one.laddr.ip for one in bound if one.laddr.port in ports}


ASKED = {"ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "FASTRTPS_DEFAULT_PROFILES_FILE"}


@pytest.mark.skipif(
    os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") != "rmw_fastrtps_cpp",
    reason="the profile is for Fast DDS",
)
def test_a_node_is_open_to_this_machine_until_one_opens_it():
    lock = DomainLock()
    try:
        assert addresses(lock.domain_id) == {"127.0.0.1"}
        opened = addresses(lock.domain_id, ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET")
        assert opened == {"0.0.0.0"}
    finally:
        lock.release()


@pytest.mark.parametrize(
    ("variables", "closed"),
    [
        ({}, True),
        ({"ROS_STATIC_PEERS": "192.0.2.1"}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, False),
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": "my.xml"}, False),
    ],
)
def test_the_profile_is_set_unless_one_opens_up(variables, closed):
    clean = {name: text for name, text in os.environ.items() if name not in ASKED}
    command = f'source "{ENV}" && source "{ENV}" && echo "$FASTRTPS_DEFAULT_PROFILES_FILE"'
    shown = subprocess.run(
        ["bash", "-c", command], env=clean | variables, capture_output=True, text=True, check=True
    ).stdout.strip()
    assert shown.endswith("/config/fastdds_this_host.xml") == closed
    own = variables.get("FASTRTPS_DEFAULT_PROFILES_FILE", "")
    assert closed or shown == own
    assert not closed or Path(shown).is_file()
