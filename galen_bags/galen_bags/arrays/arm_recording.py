# SPDX-License-Identifier: Apache-2.0
"""An arm's joint states and wrenches out of a bag, thousands of messages at a time as arrays.

A publisher's messages are alike but for stamp and numbers. So the first message's layout is worked
out, all that fit it are read by array operations, and so on with the remaining ones
(`galen_common.cdr`).
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from galen_common.arm import ArmParameters
from galen_common.cdr import (
    NS_PER_S,
    STAMP_AT,
    JointStateError,
    Layout,
    UnreadableError,
    check_joint_counts,
    joint_indices,
    joint_state_layout,
    stamped_layout,
)
from galen_model.arm.arm import MAX_URDF_BYTES, Arm
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.json_fields import FieldError, read_limited

from galen_bags.formats.bag import Bag, listing, open_bag, robot_description
from galen_bags.formats.errors import BagError
from galen_bags.formats.raw_block import Messages, windows

WRENCH_TYPE = "geometry_msgs/msg/WrenchStamped"
POSE_TYPE = "geometry_msgs/msg/PoseStamped"
JOINT_STATE_TYPE = "sensor_msgs/msg/JointState"
TEMPERATURE_TYPE = "sensor_msgs/msg/Temperature"
ARM_FILE = "arm.urdf"
"""A recording's description of its arm, beside its bags."""

_FIRST = np.zeros(1, dtype=np.intp)
_NO_MESSAGES = Messages(*[np.zeros(0, dtype=np.int64)] * 5)  # a block's, once it is decoded
_KEPT_LAYOUTS = 16
# A block in which every message is another one is not worth an array operation for each.
_MOST_LAYOUTS_A_BLOCK = 64


@dataclass(frozen=True)
class Samples:
    """Messages of one topic.

    stamp_ns (n,) int64; values (n, k): what the decoder says, NaN where it is not known;
    frame (n,) counts in `frame_ids`; `bad`: why the message at this row can't be used. A bad
    row's values are NaN; its stamp is 0 where it has none.
    """

    stamp_ns: np.ndarray
    values: Array
    frame: np.ndarray
    frame_ids: tuple[str, ...]
    bad: dict[int, str]

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamp_ns)


class Decoder:
    """Decodes one topic's messages; remembers their layouts from block to block."""

    def __init__(
        self, type_name: str, joint_names: Sequence[str] = (), required: Sequence[str] = ()
    ) -> None:
        """Take one of the four types.

        The values are a wrench's (fx, fy, fz, tx, ty, tz) N and N.m; a pose's (x, y, z, qx, qy,
        qz, qw) m; a temperature, degrees Celsius, and its variance; a joint state's positions, then
        velocities of `joint_names`. A joint state that lacks one of those `required` is bad; others
        that it lacks are NaN.
        """
        self._type_name = type_name
        self._joint_names = tuple(joint_names)
        self._required = tuple(required)
        widths = {WRENCH_TYPE: 6, POSE_TYPE: 7, TEMPERATURE_TYPE: 2}
        widths[JOINT_STATE_TYPE] = 2 * len(self._joint_names)
        if type_name not in widths:
            raise BagError(f"messages of type {type_name} can't be read here")
        self._width = widths[type_name]
        self._layouts: list[Layout] = []
        self._frame_ids: dict[str, int] = {}

    def decode(self, block: Messages, rows: np.ndarray) -> Samples:
        """Decode messages of a block.

        Args:
            block: messages of one or several topics, CDR.
            rows: (n,) indices in the block of the messages of this decoder's topic.

        Returns:
            Samples (n,), in the order of `rows`; a message that can't be read is in `bad`, by its
            place in `rows`.

        """
        count = len(rows)
        samples = Samples(
            np.zeros(count, dtype=np.int64),
            np.full((count, self._width), np.nan),
            np.zeros(count, dtype=np.intp),
            (),
            {},
        )
        left = np.arange(count)
        for layout in list(self._layouts):
            left = self._fill(samples, layout, block, rows, left)
        learnt = 0
        while len(left):
            first = int(left[0])
            data = block.message(int(rows[first]))
            try:
                layout = self._learn(data)
            except UnreadableError as error:
                samples.bad[first] = (
                    f"{len(data)} bytes came that are not a readable {self._type_name}: {error}"
                )
                left = left[1:]
                continue
            learnt += 1
            if learnt <= _MOST_LAYOUTS_A_BLOCK:
                left = self._fill(samples, layout, block, rows, left)
            else:
                self._fill(samples, layout, block, rows, left[:1])
                left = left[1:]
        return replace(samples, frame_ids=tuple(self._frame_ids) or ("",))

    def _fill(
        self, samples: Samples, layout: Layout, block: Messages, rows: np.ndarray, left: np.ndarray
    ) -> np.ndarray:
        """Fill in those of the samples `left` that are laid out so; returns the others."""
        fits = block.size[rows[left]] == layout.length
        if not fits.any():
            return left
        same = left[fits]
        cells = windows(block.data, layout.length)[block.start[rows[same]]]
        alike = np.ones(len(same), dtype=bool)
        for run, expected in layout.fixed:
            equal = cells[:, run] == np.frombuffer(expected, np.uint8)
            if not equal.all():  # over all at once: much faster than over each row
                alike &= equal.all(axis=1)
        if not alike.all():
            same, cells = same[alike], cells[alike]
            fits[fits] = alike
        samples.stamp_ns[same] = _stamps(layout, cells)
        samples.frame[same] = self._frame_ids.setdefault(layout.frame_id, len(self._frame_ids))
        try:
            samples.values[same] = self._values(layout, cells)
        except JointStateError as error:
            samples.bad.update(dict.fromkeys(same.tolist(), str(error)))
        return left[~fits]

    def _learn(self, data: bytes) -> Layout:
        if self._type_name == JOINT_STATE_TYPE:
            layout = joint_state_layout(data)
        else:
            layout = stamped_layout(data, self._width)
        self._layouts = [layout, *self._layouts[: _KEPT_LAYOUTS - 1]]
        return layout

    def _values(self, layout: Layout, rows: np.ndarray) -> Array:
        """Values (n, k) of messages of one layout; raises JointStateError."""
        if self._type_name != JOINT_STATE_TYPE:
            return _doubles(layout, rows, 0)
        joint_indices(self._required, layout.names)
        positions, velocities = layout.counts[0], layout.counts[1]
        check_joint_counts(len(layout.names), positions, velocities)
        values = np.full((len(rows), self._width), np.nan)
        joints = len(self._joint_names)
        there = [k for k, name in enumerate(self._joint_names) if name in layout.names]
        source = [layout.names.index(self._joint_names[k]) for k in there]
        values[:, there] = _doubles(layout, rows, 0)[:, source]
        if velocities:
            values[:, [joints + k for k in there]] = _doubles(layout, rows, 1)[:, source]
        return values


def _stamps(layout: Layout, rows: np.ndarray) -> np.ndarray:
    seconds = np.ascontiguousarray(rows[:, STAMP_AT : STAMP_AT + 4]).view(layout.order + "i4")
    rest = np.ascontiguousarray(rows[:, STAMP_AT + 4 : STAMP_AT + 8]).view(layout.order + "u4")
    return seconds[:, 0].astype(np.int64) * NS_PER_S + rest[:, 0]


def _doubles(layout: Layout, rows: np.ndarray, run: int) -> Array:
    """One of the runs of doubles (n, count)."""
    count = layout.counts[run]
    start = layout.doubles_at[run]
    cells = np.ascontiguousarray(rows[:, start : start + 8 * count])
    return cells.view(layout.order + "f8").astype(np.float64, copy=False).reshape(-1, count)


def join_samples(parts: list[Samples], width: int) -> Samples:
    """Join the samples of all blocks, one after the other.

    Args:
        parts: one decoder's samples, in the order of decoding: the last one's frame ids stand for
            all, since a decoder's only grow.
        width: number of values of a message, where there are no parts.

    Returns:
        Samples of all parts; the rows in `bad` count through them.

    """
    if not parts:
        none = np.zeros(0, dtype=np.int64)
        return Samples(none, np.zeros((0, width)), none, ("",), {})
    first = np.cumsum([0, *(len(part) for part in parts)])
    bad = {
        int(first[k]) + row: reason
        for k, part in enumerate(parts)
        for row, reason in part.bad.items()
    }
    return Samples(
        np.concatenate([part.stamp_ns for part in parts]),
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.frame for part in parts]),
        parts[-1].frame_ids,
        bad,
    )


# The arm


@dataclass(frozen=True)
class ArmTopics:
    """Where the arm's samples are in a bag.

    A topic is taken by its whole name, or else as the only one of its type that ends with it, so
    that recordings of a namespace need no option; by default, as the only one of its type.
    `joint_names`: the arm's joints in their order, empty: as the arm has them; the turning ones
    must be there, the others need not. wrench_frame: "sensor", or "base" where wrenches are written
    in the base's axes, about the sensor's origin: they are turned back at each joint state.
    log_times: whether messages are taken as stamped when they were logged.
    """

    joint_states: str = "joint_states"
    wrench_raw: str = "wrench_raw"
    joint_names: tuple[str, ...] = ()
    wrench_frame: str = "sensor"
    log_times: bool = False

    def find(self, bag: Bag, type_name: str) -> str:
        """Find the bag's topic of the joints or of the wrench.

        Args:
            bag: an open bag.
            type_name: WRENCH_TYPE for the wrench's topic; any other for the joints'.

        Returns:
            The topic's full name. With the default name, the only topic of the type is taken; one
            with `compensated` in its name never is.

        Raises:
            BagError: there is no such topic, or several may be meant; it names those there are.

        """
        field_name = "wrench_raw" if type_name == WRENCH_TYPE else "joint_states"
        name = getattr(self, field_name)
        # A compensated wrench would be taken for a raw one.
        usable = [topic for topic in _of_type(bag, type_name) if "compensated" not in topic]
        try:
            return find_topic(bag, name, type_name)
        except BagError as error:
            if name == getattr(ArmTopics, field_name) and len(usable) == 1:
                return usable[0]
            remedy = f"; name the one to read: --{field_name.replace('_', '-')} TOPIC"
            if not usable:
                remedy = "; record joint states: tf does not hold the joints' angles"
                if type_name == WRENCH_TYPE:
                    remedy = "; record the sensor's own readings"
            cut = "".join(f"; {problem}" for problem in bag.problems)
            raise BagError(f"{error}{cut or remedy}") from error

    def temperature(self, bag: Bag, wrench_raw: str) -> str:
        """Find the topic of the sensor's temperature.

        Args:
            bag: an open bag.
            wrench_raw: full name of the wrenches' topic.

        Returns:
            The bag's only topic of temperatures, or the only one in the namespace of the wrenches;
            empty where neither is certain.

        """
        topics = _of_type(bag, TEMPERATURE_TYPE)
        beside = [t for t in topics if t.rpartition("/")[0] == wrench_raw.rpartition("/")[0]]
        return next((one[0] for one in (topics, beside) if len(one) == 1), "")


def topics_of(arguments: argparse.Namespace) -> ArmTopics:
    """Make the topics from the options of `add_arm_topics` and `add_wrench_frame`.

    Args:
        arguments: a command's parsed options.

    Returns:
        Names of topics and joints, the wrenches' frame and the source of stamps.

    """
    names = tuple(arguments.joint_names.split(",")) if arguments.joint_names else ()
    return ArmTopics(
        arguments.joint_states,
        arguments.wrench_raw,
        names,
        arguments.wrench_frame,
        arguments.log_times,
    )


def arm_of_bag(bag: Bag, parameters: ArmParameters, topics: ArmTopics | None = None) -> Arm:
    """Return the arm of the parameters' file, else of the bag's description, else the Galen.

    The description is that of `description_of_bag`. A described arm's sensor frame is the wrenches'
    own `frame_id`, unless the parameters name one.

    Args:
        bag: an open bag.
        parameters: the file of a description, the sensor's frame and what else picks an arm.
        topics: where the wrenches are, for their `frame_id`; None: the defaults.

    Returns:
        The arm whose joint states and wrenches the bag holds.

    Raises:
        BagError: the bag has no topic of wrenches, or their `frame_id` is none of the arm's frames.
        GalenError: a description can't be read, or is of no usable arm.

    """
    text, topics = description_of_bag(bag), topics or ArmTopics()
    if not (text or parameters.urdf_file) or parameters.sensor_frame != ArmParameters.sensor_frame:
        return parameters.arm(text)
    topic = topics.find(bag, WRENCH_TYPE)
    block = next(bag.blocks([topic]), None)
    frame = "" if block is None else Decoder(WRENCH_TYPE).decode(block, _FIRST).frame_ids[-1]
    try:
        arm = replace(parameters, sensor_frame=frame or parameters.sensor_frame).arm(text)
    except GalenError as error:
        raise BagError(f"{bag.path}: {_odd_frame(topic, frame, topics, str(error))}") from error
    return arm


def description_of_bag(bag: Bag) -> str:
    """Return the bag's `robot_description`, else `arm.urdf` in its directory or the one above.

    Args:
        bag: an open bag.

    Returns:
        The robot's description (URDF); empty where there is none.

    Raises:
        GalenError: it can't be read; the message names the bag or the file.

    """
    if text := robot_description(bag):
        return text
    folder = bag.path if bag.path.is_dir() else bag.path.parent
    for file in (folder / ARM_FILE, folder.parent / ARM_FILE):
        try:
            return read_limited(file, MAX_URDF_BYTES, "a robot description").decode()
        except FileNotFoundError:
            continue
        except (OSError, UnicodeDecodeError, FieldError) as error:
            raise GalenError(f"{file}: can't be read: {error}") from error
    return ""


def _odd_frame(topic: str, frame: str, topics: ArmTopics, error: str) -> str:
    """Say why a wrench's `frame_id` is no sensor's, with the remedy."""
    if not frame:
        return f"{topic} has an empty frame_id: name the sensor's frame (--sensor-frame); {error}"
    text = f"{topic} has frame_id {frame!r}: {error}; --sensor-frame names the sensor's frame"
    if topics.wrench_frame == "sensor":
        text += ", and --wrench-frame base says that wrenches are in the base's axes, if they are"
    return text


@dataclass(frozen=True)
class ArmBlock:
    """Samples of both topics in the order of their log times.

    is_wrench (n,) tells whose the next sample is. `joints.values` (nj, 2 k): positions, then
    velocities, m and rad; `wrenches.values` (nw, 6): N and N.m. The log times are in ns.
    `messages`: the block as it was read; with other topics in it if they were asked for.
    """

    is_wrench: np.ndarray
    joints: Samples
    joint_log_ns: np.ndarray
    wrenches: Samples
    wrench_log_ns: np.ndarray
    messages: Messages


class ArmReader:
    """Reads the arm's samples out of an open bag."""

    def __init__(
        self,
        bag: Bag,
        topics: ArmTopics | None = None,
        *,
        arm: Arm,
        all_topics: bool = False,
        start_s: float = 0.0,
        duration_s: float | None = None,
    ) -> None:
        """Find the topics; raises BagError that names those there are.

        `all_topics`: have the bag's other topics in the blocks' `messages`, too. Only messages
        of the `duration_s` (None: all) from `start_s` after the first one's log time on are read.
        """
        topics = topics or ArmTopics()
        names, count = topics.joint_names or arm.joint_names, len(arm.joints)
        if len(names) != count:
            raise BagError(f"{len(names)} joint names; the arm has {count} joints")
        self.bag = bag
        self._start_s = start_s
        self._duration_s = math.inf if duration_s is None else duration_s
        self._arm, self._log_times = arm, topics.log_times
        self._turned = topics.wrench_frame == "base"
        self.joint_states = topics.find(bag, JOINT_STATE_TYPE)
        self.wrench_raw = topics.find(bag, WRENCH_TYPE)
        self.read_topics = [self.joint_states, self.wrench_raw]
        if all_topics:
            self.read_topics += [
                topic.name
                for topic in bag.topics.values()
                if topic.name not in self.read_topics and topic.encoding == "cdr"
            ]
        turning = [names[k] for k in arm.turning]
        self._joints = Decoder(JOINT_STATE_TYPE, names, required=turning)
        self._wrenches = Decoder(WRENCH_TYPE)

    @property
    def message_count(self) -> int | None:
        """Messages of both topics; None if the bag does not say."""
        counts = [self.bag.topics[name].count for name in (self.joint_states, self.wrench_raw)]
        return None if None in counts else sum(count or 0 for count in counts)

    def blocks(self) -> Iterator[ArmBlock]:
        """Return the samples, block by block."""
        into_sensor = self._into_sensor() if self._turned else None
        for block in self._inside_window():
            joint_rows = np.flatnonzero(block.topic == 0)
            wrench_rows = np.flatnonzero(block.topic == 1)
            joints = self.stamped(self._joints, block, joint_rows)
            wrenches = self.stamped(self._wrenches, block, wrench_rows)
            if into_sensor is not None:
                wrenches = into_sensor(wrenches)
            yield ArmBlock(
                block.topic[block.topic < 2] == 1,
                joints,
                block.log_time_ns[joint_rows],
                wrenches,
                block.log_time_ns[wrench_rows],
                block,
            )

    def stamped(self, decoder: Decoder, block: Messages, rows: np.ndarray) -> Samples:
        """Decode rows of a block, with log times for stamps where these are asked for.

        Args:
            decoder: of the rows' type.
            block: messages of `read_topics`.
            rows: which of them.

        Returns:
            The samples.

        """
        samples = decoder.decode(block, rows)
        return replace(samples, stamp_ns=block.log_time_ns[rows]) if self._log_times else samples

    def _into_sensor(self) -> Callable[[Samples], Samples]:
        """Read all joint states, and return what turns wrenches out of the base's axes."""
        count = len(self._arm.joints)
        parts = [
            self.stamped(self._joints, block, np.arange(len(block.topic)))
            for block in self.bag.blocks([self.joint_states])
        ]
        joints = join_samples(parts, 2 * count)
        good = np.setdiff1d(np.arange(len(joints)), list(joints.bad))
        order = good[np.argsort(joints.stamp_ns[good], kind="stable")]
        stamps = joints.stamp_ns[order]
        angles = np.unwrap(self._arm.angles(joints.values[order, :count]), axis=0)
        first_ns = stamps[0] if len(stamps) else 0

        def turn(wrenches: Samples) -> Samples:
            if not len(stamps) or not len(wrenches):
                return wrenches
            at_s, own_s = (wrenches.stamp_ns - first_ns) * 1e-9, (stamps - first_ns) * 1e-9
            then = np.column_stack([np.interp(at_s, own_s, column) for column in angles.T])
            rotation = self._arm.rotation(then)
            values = [
                np.einsum("nji,nj->ni", rotation, part)
                for part in np.split(wrenches.values, 2, axis=1)
            ]
            frame_ids = (self._arm.sensor_frame,) * len(wrenches.frame_ids)
            return replace(wrenches, values=np.concatenate(values, axis=1), frame_ids=frame_ids)

        return turn

    def _inside_window(self) -> Iterator[Messages]:
        first_ns: int | None = None
        for block in self.bag.blocks(self.read_topics):
            if first_ns is None:
                first_ns = int(block.log_time_ns[0])
            since_s = (block.log_time_ns - first_ns) * 1e-9
            inside = (since_s >= self._start_s) & (since_s < self._start_s + self._duration_s)
            if inside.all():
                yield block
            elif inside.any():
                yield block.rows(inside)
            elif since_s[0] >= self._start_s + self._duration_s:
                return


def find_topic(bag: Bag, name: str, type_name: str) -> str:
    """Find the bag's topic `name`, or the only one of its type that ends with it.

    Args:
        bag: an open bag.
        name: whole name or its last parts, with a leading slash or without.
        type_name: the message type it must have, such as `geometry_msgs/msg/WrenchStamped`.

    Returns:
        The topic's name as the bag has it.

    Raises:
        BagError: there is none, there are several, or it has another type.

    """
    bare = name.lstrip("/")
    # Some recorders leave the first slash out.
    for exact in ("/" + bare, bare):
        if exact in bag.topics:
            found = bag.topics[exact].type_name or "topic without a type"
            if found != type_name:
                raise BagError(f"{bag.path}: {exact} is a {found}, not a {type_name}")
            return exact
    of_type = _of_type(bag, type_name)
    ending = [topic for topic in of_type if topic.endswith("/" + bare)]
    if len(ending) == 1:
        return ending[0]
    if ending:
        raise BagError(f"{bag.path}: several topics end with /{bare}: {listing(ending)}")
    raise BagError(
        f"{bag.path}: has no topic {'/' + bare}; of type {type_name} it has {listing(of_type)}"
        if of_type
        else f"{bag.path}: has no topic of type {type_name}; it has {listing(bag.topics)}"
    )


def _of_type(bag: Bag, type_name: str) -> list[str]:
    return [topic.name for topic in bag.topics.values() if topic.type_name == type_name]


@dataclass(frozen=True)
class ArmRecording:
    """A whole recording in memory, about half a kilobyte a message: minutes, not hours.

    joint_stamp_ns (n,), joints (n, k) m and rad, joint_velocities (n, k) NaN where the messages
    have none; wrench_stamp_ns (m,), wrenches (m, 6) N and N.m; log times in ns; messages that
    can't be used are left out and named in `problems`, beside what is wrong with the bag. topics:
    of joint states, wrenches and, where there is one, temperatures; temperature_c (k,), degrees
    Celsius, in the order of their stamps.
    """

    path: Path
    joint_stamp_ns: np.ndarray
    joint_log_ns: np.ndarray
    joints: Array
    joint_velocities: Array
    wrench_stamp_ns: np.ndarray
    wrench_log_ns: np.ndarray
    wrenches: Array
    frame_ids: tuple[str, ...]
    problems: tuple[str, ...]
    topics: tuple[str, ...] = ()
    temperature_stamp_ns: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    temperature_c: Array = field(default_factory=lambda: np.zeros(0))


def read_arm(
    path: str | os.PathLike[str],
    topics: ArmTopics | None = None,
    *,
    arm: Arm,
    progress: Callable[[Iterator[ArmBlock]], Iterable[ArmBlock]] = iter,
) -> ArmRecording:
    """Read a bag's joint states and wrenches, and the sensor's temperature where it has one.

    Args:
        path: a bag: rosbag2 directory, .mcap or .db3.
        topics: where the samples are; None: the defaults.
        arm: whose joint names are looked up in the joint states.
        progress: wraps the iterator of blocks as they are read, for a progress bar.

    Returns:
        The whole recording, in memory.

    Raises:
        BagError: the bag can't be read, lacks a topic, or a topic has no usable message.

    """
    topics = topics or ArmTopics()
    with open_bag(path) as bag:
        reader = ArmReader(bag, topics, arm=arm)
        names = [reader.joint_states, reader.wrench_raw]
        if temperature := topics.temperature(bag, reader.wrench_raw):
            reader.read_topics.append(temperature)
        warm, blocks, decoder = [], [], Decoder(TEMPERATURE_TYPE)
        for block in progress(reader.blocks()):
            blocks.append(replace(block, messages=_NO_MESSAGES))
            rows = np.flatnonzero(block.messages.topic == 2)
            warm.append(reader.stamped(decoder, block.messages, rows))
        problems = bag.problems
    count = len(arm.joints)
    joints = join_samples([block.joints for block in blocks], 2 * count)
    wrenches = join_samples([block.wrenches for block in blocks], 6)
    kept: list[np.ndarray | slice] = []
    for name, samples in zip(names, (joints, wrenches), strict=True):
        good = np.setdiff1d(np.arange(len(samples)), list(samples.bad))
        reason = next(iter(samples.bad.values()), "")
        if not len(samples):
            raise BagError(f"{path}: {name} has no message" + "".join(f"; {p}" for p in problems))
        if not len(good):
            remedy = ""
            if samples is joints:
                remedy = (
                    f"; another arm than '{arm.name}' needs its description (robot_description in"
                    " the bag, or --urdf FILE), other names of its joints --joint-names"
                )
            raise BagError(f"{path}: {name} has no usable message: {reason}{remedy}")
        if samples.bad:
            how_many = f"{len(samples.bad)} message{'s' if len(samples.bad) > 1 else ''}"
            problems.append(f"{name}: {how_many} can't be used: {reason}")
        kept.append(good if samples.bad else slice(None))  # a slice copies nothing
    degrees = join_samples(warm, 2)
    usable = np.flatnonzero(np.isfinite(degrees.values[:, 0]))
    usable = usable[np.argsort(degrees.stamp_ns[usable], kind="stable")]
    joint_log = np.concatenate([block.joint_log_ns for block in blocks])
    wrench_log = np.concatenate([block.wrench_log_ns for block in blocks])
    return ArmRecording(
        Path(path),
        joints.stamp_ns[kept[0]],
        joint_log[kept[0]],
        joints.values[kept[0], :count],
        joints.values[kept[0], count:],
        wrenches.stamp_ns[kept[1]],
        wrench_log[kept[1]],
        wrenches.values[kept[1]],
        tuple(dict.fromkeys(wrenches.frame_ids[k] for k in np.unique(wrenches.frame[kept[1]]))),
        tuple(problems),
        tuple([*names, temperature] if len(usable) else names),
        degrees.stamp_ns[usable],
        degrees.values[usable, 0],
    )
