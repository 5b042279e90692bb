# SPDX-License-Identifier: Apache-2.0
"""Live nodes under requests, goals, parameters and messages that make no sense.

All nodes that take requests run in one process, whose thread ends with the first exception in a
callback, as their processes do. Made from seeds; the soak tests ask for all that there is.
"""

from __future__ import annotations

import contextlib
import math
import random
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bad_requests import ACTIONS, SERVICES, World, garbage, told, wrong, wrong_values
from galen_common.parameters import ParameterError, checked, param_fields
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_ros.node.managed_node import ManagedNode
from galen_ros.node.testing import Harness, Lifecycle
from galen_sim_driver.parameters import DriverParameters, EffectParameters, effects_of
from galen_sim_driver.plant.cell import Plant
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import SetParametersAtomically

RCLPYS = ("use_sim_time", "start_type_description_service")
"""Parameters that rclpy itself declares."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with Harness() as harness:
        world = World(harness, tmp_path_factory.mktemp("world"))
        before = world.files()
        yield world
        print(
            f"\n{world.count} requests, goals, parameters and messages; {world.rejected} rejected"
        )
        world.compensates()
        assert world.files() == before


def ask(world: World, rng: random.Random, times: int) -> None:
    for name, (kind, right, bad) in SERVICES.items():
        for _ in range(times):
            request = wrong(rng, right, bad)
            answer = world.call(name, kind, **request)
            assert not answer.success, f"{name} took {request!r:.300}"
            told(answer.error_msg)


def send(world: World, rng: random.Random, times: int) -> None:
    for name, (kind, right, bad) in ACTIONS.items():
        for _ in range(times):
            goal = wrong(rng, right, bad)
            result = world.goal(name, kind, **goal)
            assert result.error_code not in (0, kind.Result.INTERNAL), f"{name}: {goal!r:.300}"
            told(result.error_msg)


def test_services_say_no(world: World) -> None:
    ask(world, random.Random(1), 8)
    world.compensates()


def test_goals_end_at_once_with_the_reason(world: World) -> None:
    send(world, random.Random(2), 6)
    world.compensates()


def test_parameters_are_rejected_or_do_no_harm(world: World) -> None:
    """Of any type at all, also of one that ROS doesn't know: rclpy alone would end with it."""
    rng = random.Random(3)
    for node in world.nodes:
        names = world.names_of(node)
        values = wrong_values()
        for name, value in zip(rng.sample(names, 12), rng.choices(values, k=12), strict=True):
            world.set_and_back(node, name, value)
        assert world.set(node, names[0], wrong_values()[-1])  # of no type
        assert world.set(node, "\x1b[2J" * 10_000, wrong_values()[-1])
        request = {"parameters": [world.parameter(name, values[-1]) for name in names[:3]]}
        service = f"{node.get_name()}/set_parameters_atomically"
        answer = world.call(service, SetParametersAtomically, **request)
        assert not answer.result.successful
        told(answer.result.reason)
    world.compensates()


def litter(world: World, rng: random.Random, times: int) -> None:
    """To everything that any node hears."""
    for node in world.nodes:
        for heard in list(node.subscriptions):
            publisher = world.person.create_publisher(
                heard.msg_type, heard.topic_name, heard.qos_profile
            )
            world.harness.wait_for(publisher.get_subscription_count, 10.0, heard.topic_name)
            for data in garbage(rng, heard.msg_type, times):
                publisher.publish(data)
                world.count += 1
            world.let_them_work()
            world.person.destroy_publisher(publisher)


def test_bytes_that_are_no_messages_end_no_node(world: World) -> None:
    litter(world, random.Random(4), 20)
    world.compensates()


FLOATS = [1e12, -1e12, 1e9, 1e6, -1e6, -1.0, 0.0, 1e-300, 5e-324, -5e-324]


def step_with(kind: type, name: str, value: Any) -> bool:
    """Whether the simulated arm takes the parameter; its readings are then numbers."""
    try:
        given = replace(kind(), **{name: value})
        driver = given if kind is DriverParameters else DriverParameters()
        effects = effects_of(given if kind is EffectParameters else EffectParameters())
        plant = Plant(
            replace(driver.plant_config(arm=GALEN), effects=effects), np.random.default_rng(0)
        )
    except GalenError:
        return False
    plant.attach_tool("pointer")
    for _ in range(10):
        sample = plant.step()
    assert np.isfinite(sample.wrench).all() and np.isfinite(sample.positions).all(), (name, value)
    return True


def test_a_cable_of_hardly_any_tension_is_none() -> None:
    assert step_with(EffectParameters, "cable_drag_tension_n", 5e-324)


@pytest.mark.parametrize("value", [1e13, -1e300, math.inf, math.nan])
def test_no_float_is_beyond_any_arm(value: float) -> None:
    hint, _, meaning = param_fields(DriverParameters)["adapter_mass_kg"]
    with pytest.raises(ParameterError, match=r"no larger than 1e\+12"):
        checked("x", value, hint, meaning)


# --- long -----------------------------------------------------------------------------------------


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_much_more_of_it(world: World) -> None:
    rng = random.Random(5)
    ask(world, rng, 150)
    send(world, rng, 100)
    litter(world, rng, 1000)
    world.compensates()


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_a_managed_node_configures_with_what_it_took_or_says_why_not(world: World) -> None:
    """Cleaned up, it takes what it rejects while it works."""
    rng = random.Random(6)
    for node in world.nodes:
        if not isinstance(node, ManagedNode):
            continue
        life = Lifecycle(world.harness, world.person, node.get_name())
        assert life.go("deactivate", "cleanup")
        for name in world.names_of(node):
            if name in RCLPYS:
                continue
            (old,) = world.values_of(node, [name])
            taken = False
            for value in rng.sample(wrong_values(), 12):
                if world.set(node, name, value):
                    continue
                taken = True
                if not life.go("configure"):
                    assert isinstance(node._error, GalenError), (name, node._error)
                    told(str(node._error))
                else:
                    assert life.go("activate"), (name, value, node._error)
                    print(f"{name} {str(value)[:300]}")  # what ended the node, if it did
                    world.let_them_work()
                    assert life.go("deactivate", "cleanup")
            if taken and old.type != ParameterType.PARAMETER_NOT_SET:
                assert world.set(node, name, old) == ""
        assert life.go("configure", "activate")
    world.compensates()


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_the_simulated_arm_reads_numbers_whatever_the_parameters() -> None:
    tried = taken = 0
    for kind in (DriverParameters, EffectParameters):
        for name, (hint, default, meaning) in param_fields(kind).items():
            for value in FLOATS if hint in (float, tuple[float, ...]) else ():
                tried += 1
                given = value if hint is float else (value,) * max(1, len(default))
                with contextlib.suppress(ParameterError):
                    taken += step_with(kind, name, checked(name, given, hint, meaning))
    print(f"\n{tried} parameters of the simulated arm tried, {taken} taken")
