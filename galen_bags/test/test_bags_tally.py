# SPDX-License-Identifier: Apache-2.0
"""Counts of a recording, definitions of types, arguments of the commands, without ROS."""

import pytest
from galen_bags.ros.recorder import TopicCounts
from galen_bags.ros.topics import find_definition
from galen_common.command import own_arguments
from rosbags.typesys import get_types_from_msg


@pytest.mark.parametrize(
    ("batches", "lost"),
    [
        ([([1, 2, 3], True), ([4, 5], True)], 0),
        ([([7, 8], True)], 0),  # what came before the subscription is not lost
        ([([1, 2, 5], True)], 2),
        ([([1, 2], True), ([5], True)], 2),
        ([([100, 101, 1, 2], True), ([4], True)], 1),  # the publisher was restarted
        ([([5000, 3, 5001, 4], False), ([5002, 5003], True)], 0),  # two publishers
        ([([None, None], True), ([4], True)], 0),  # a middleware that does not number
    ],
)
def test_gaps_in_sequence_numbers(batches, lost):
    counter = TopicCounts("/w", "a/msg/B")
    for numbers, one_publisher in batches:
        for number in numbers:
            counter.add_number(number)
        counter.end_batch(one_publisher)
    assert counter.lost == lost


@pytest.mark.parametrize(
    ("text", "own"),
    [
        ("bag -m a:=b", "bag -m a:=b"),
        ("bag --ros-args -r a:=b", "bag"),
        ("bag --ros-args -r a:=b -- -r 2", "bag -r 2"),
    ],
)
def test_arguments_for_ros_are_apart(text, own):
    assert own_arguments(text.split()) == own.split()


def install(share, type_name, text):
    package, name = type_name.split("/")
    folder = share / package / "msg"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.msg").write_text(text)


def test_a_definition_comes_with_all_types_in_it(tmp_path):
    install(
        tmp_path, "one/Outer", "# a two/Comment x\nInner[<=3] inner\ntwo/Deep deep\nuint8 A=1\n"
    )
    install(tmp_path, "one/Inner", "float64[36] values # two/NotThis y\nstring<=5 name\n")
    install(tmp_path, "two/Deep", "one/Inner again\nbool b\nbyte[] data\nwstring w\n")
    text = find_definition("one/msg/Outer", lambda package: tmp_path / package)
    types = get_types_from_msg(text, "one/msg/Outer")
    assert sorted(types) == ["one/msg/Inner", "one/msg/Outer", "two/msg/Deep"]
    assert [name for name, _ in types["one/msg/Outer"][1]] == ["inner", "deep"]
    assert text.count("MSG: one/Inner") == 1
