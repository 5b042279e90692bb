# SPDX-License-Identifier: Apache-2.0
"""A recording against the nominal simulator: whitened rows, and how they change with effects.

Residuals of all samples are whitened (`noise.py`), then averaged over groups of a few samples. What
an effect changes of the prediction is smooth from sample to sample, so it is computed once a group,
at the group's mean time, and scaled by what whitening and averaging make of a constant:

    row(effects) = row(nominal) - gain (prediction(effects) - prediction(nominal)).

Beside effects, a recording has unknowns that are no gap: the sensor's zero (6), where base_link is
in the tracker (6), the mean of the base's marker (6). `Unknowns` are parameters of the prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.load.model import ToolGeometry
from galen_model.registration import Transform, solve_base
from galen_model.rotation import matrix_to_rotvec, rotvec_to_matrix
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.replay import Between, Replay, Scene

from galen_diagnosis.observation.noise import ChannelNoise, channel_noise
from galen_diagnosis.observation.recording import (
    BagData,
    DiagnosticRecording,
    Readings,
    Track,
)
from galen_diagnosis.observation.rows import (
    BAGS,
    MARKER_AXES,
    TIP_AXES,
    Groups,
    Phases,
    ResidualRows,
    Stream,
    blocks,
    deal,
    group_mean,
    groups_of,
    middle,
    moving_regime,
    phases,
    push_regime,
    stretches,
    touched,
    whitened,
)

_GROUP_S = {"sweep": 0.1, "motion": 0.025, "push": 0.1}
_TOUCHED_GROUP_S = 0.04
"""Pushes come and go within some tenths of a second, and the tip with them."""
_TRACK_GROUP_S = 0.05
_KNOT_S = {"sweep": 5.0, "motion": 0.4, "push": 5.0}
_REST_KNOT_S = 5.0
_QUIET = 500
_QUIET_TRACKS = 300
_TRACK_KNOT_S = 0.4
LEAST_NOISE = np.array([1e-4] * 3 + [1e-6] * 3)
"""Of a reading: less is a simulation's, or digits that are missing."""
_USUAL_TRACKER_NOISE = [
    *[ChannelNoise(np.zeros(0), 3e-5)] * 3,
    *[ChannelNoise(np.zeros(0), 1e-4)] * 3,
]
"""Of a tracker whose own noise is not known: m, rad."""
UNKNOWNS = 18


@dataclass(frozen=True)
class Unknowns:
    """What isn't known and no gap.

    offset (6,): of the reading, N and N.m. base (6,): how base_link is displaced in the tracker
    from the observation's first estimate, along base_link: m, rad. marker (6,): displacement of the
    base's marker from its mean. More are weights of a table's own unknowns.
    """

    values: Array

    @staticmethod
    def none() -> Unknowns:
        """All zero."""
        return Unknowns(np.zeros(UNKNOWNS))

    @property
    def offset(self) -> Array:
        """Of the reading (6,)."""
        return self.values[:6]

    @property
    def base(self) -> Array:
        """Of base_link in the tracker (6,)."""
        return self.values[6:12]

    @property
    def marker(self) -> Array:
        """Of the base's marker (6,)."""
        return self.values[12:UNKNOWNS]


@dataclass(frozen=True)
class BagView:
    """One bag's thinned scene, and how its rows lie.

    scene: at the groups' mean times. shows (nw,): groups whose wrench is scored. gains: what a
    constant change of wrench (nw, 6), tip and marker (nt, 6) becomes in the rows; leads: where
    values at the scene's times show earlier than a change does, None where they don't.
    """

    scene: Scene
    shows: np.ndarray
    gains: tuple[Array, Array, Array]
    leads: tuple[Between | None, Between | None, Between | None]

    @property
    def tracks(self) -> bool:
        """Whether the tracker was on."""
        return len(self.gains[1]) > 0


_Prediction = tuple[Array, Array, Array]
_Part = tuple[dict[str, np.ndarray], Array]
"""Where rows come from, and their values."""


class Observation:
    """What was measured, as rows; `residual` gives them under effects and unknowns."""

    def __init__(self, recording: DiagnosticRecording) -> None:
        """Whiten with the noise of the nominal residual; raises GalenError for too little."""
        self.recording = recording
        self.base_in_tracker: Transform | None = None
        self.views: dict[str, BagView] = {}
        self.streams: list[Stream] = []
        self.noise: dict[str, list[ChannelNoise]] = {}
        parts: list[_Part] = []
        first_block = 0
        for name, bag in recording.bags.items():
            rows, values = self._add(name, bag)
            numbers, block = np.unique(rows["block"], return_inverse=True)
            rows["block"] = block + first_block
            rows["fold"] = deal(len(numbers), BAGS.index(name))[block]
            first_block += len(numbers)
            parts.append((rows, values))
        joined, self.nominal = _joined(parts)
        self.unknown = self._unknown(len(self.nominal))
        """Columns (N, k) of a table's own unknowns, beside those that all recordings have."""
        readings = recording.readings
        self.rows = ResidualRows(
            **joined, arm=recording.arm, labels=() if readings is None else readings.labels
        )
        if first_block < 2:
            raise GalenError(
                f"{recording.name}: one pose, or three seconds, is all there is; nothing is "
                "left to score a fit on"
            )
        self._none = {name: self._predictions(view, (), None) for name, view in self.views.items()}

    # The simulator's predictions

    def residual(self, effects: Sequence[Effect], unknowns: Unknowns | None = None) -> Array:
        """Return the rows with effects in the simulator.

        Args:
            effects: Beside those of the nominal model.
            unknowns: Beside the effects; None for zero.

        Returns:
            Whitened residuals, (N,).

        """
        return self.nominal - self.change(effects, unknowns)

    def change(self, effects: Sequence[Effect], unknowns: Unknowns | None = None) -> Array:
        """Return what effects and unknowns add to the prediction.

        Args:
            effects: Beside those of the nominal model.
            unknowns: Beside the effects; None for zero.

        Returns:
            Changes in the rows' units, (N,).

        """
        out = []
        for name, view in self.views.items():
            parts = self._difference(name, effects, unknowns)
            led = [
                part if lead is None else lead.of(part)
                for part, lead in zip(parts, view.leads, strict=True)
            ]
            led[0] = led[0][view.shows]
            out += [(gain * part).ravel() for gain, part in zip(view.gains, led, strict=True)]
        changes = np.concatenate(out)
        if unknowns is not None and len(unknowns.values) > UNKNOWNS:
            changes += self.unknown @ unknowns.values[UNKNOWNS:]
        return changes

    def nominal_reading(self, name: str) -> Array:
        """Return what the nominal arm would read, untouched.

        Args:
            name: Name of the bag.

        Returns:
            Readings in ft_sensor at the times of the wrench's groups, (n, 6), N and N.m.

        """
        return self._none[name][0]

    def applied_load(self, name: str) -> tuple[Array, Array]:
        """Return the applied wrench by the nominal arm, reading less prediction.

        Args:
            name: Name of the bag.

        Returns:
            Times of the wrench's groups, (n,), s since the bag's first stamp, and wrenches in
            ft_sensor, (n, 6), N and N.m, 0 where untouched.

        """
        scene = self.views[name].scene
        load = scene.reading - self._none[name][0]
        return scene.wrench_s, np.where(scene.touched[:, None], load, 0.0)

    def sensor_poses(self, most: int) -> tuple[Array, Array]:
        """Return the sensor's poses at some of the reported joints of all bags.

        Args:
            most: About how many.

        Returns:
            Rotations R_base_sensor (m, 3, 3) and origins in base_link (m, 3), m.

        """
        joints = np.concatenate([view.scene.joints for view in self.views.values()])
        return self.recording.arm.sensor_pose(joints[:: max(len(joints) // most, 1)])

    def streams_with(
        self, effects: Sequence[Effect], unknowns: Unknowns | None = None
    ) -> tuple[Stream, ...]:
        """Return the residual streams with effects and unknowns in the simulator.

        Args:
            effects: Beside those of the nominal model.
            unknowns: Beside the effects; None for zero.

        Returns:
            One for each of `streams`, in the channels' units.

        """
        out = []
        changes = {name: self._difference(name, effects, unknowns) for name in self.views}
        for stream in self.streams:
            scene = self.views[stream.bag].scene
            kind = (WRENCH_AXES, TIP_AXES, MARKER_AXES).index(stream.channels)
            known_s = scene.wrench_s if kind == 0 else scene.tracker_s
            there = _at(stream.at_s, known_s, changes[stream.bag][kind])
            out.append(replace(stream, residual=stream.residual - there))
        return tuple(out)

    def _difference(
        self, name: str, effects: Sequence[Effect], unknowns: Unknowns | None
    ) -> _Prediction:
        """How wrench (nw, 6), tip and marker (nt, 6) differ from the nominal prediction's."""
        wrench, tip, marker = self._predictions(self.views[name], effects, unknowns)
        old_wrench, old_tip, old_marker = self._none[name]
        moved = tip[:, :3] - old_tip[:, :3]
        if len(tip):
            old = old_tip[:, 3:].reshape(-1, 3, 3)
            turned = _rotvec(tip[:, 3:].reshape(-1, 3, 3) @ np.swapaxes(old, -1, -2))
            moved = np.concatenate([moved, turned], axis=1)
        else:
            moved = np.zeros((0, 6))
        return wrench - old_wrench, moved, marker - old_marker

    def _predictions(
        self, view: BagView, effects: Sequence[Effect], unknowns: Unknowns | None
    ) -> _Prediction:
        """Wrench (nw, 6), tip in base_link as (nt, 12) (position, rotation matrix), marker (nt, 6).

        The tip is the tracker's, seen from where base_link was first estimated to be.
        """
        known = unknowns or Unknowns.none()
        replay = Replay(view.scene, effects)
        wrench = replay.reading() + known.offset
        if not view.tracks:
            return wrench, np.zeros((0, 12)), np.zeros((0, 6))
        base = self.base_in_tracker
        assert base is not None
        applied = replay.applied_wrench()
        applied = np.where(view.scene.touched[:, None], applied - known.offset, 0.0)
        rotation, position = replay.tip(applied)
        moved = Transform(
            base.rotation @ rotvec_to_matrix(np.array(known.base[3:])),
            base.translation + base.rotation @ known.base[:3],
        )
        turned, there = replay.seen_by_tracker(
            rotation, position, moved.rotation, moved.translation
        )
        back = base.rotation.T
        tip = np.concatenate(
            [(there - base.translation) @ back.T, (back @ turned).reshape(-1, 9)], axis=1
        )
        return wrench, tip, replay.base_marker() + known.marker

    # Rows

    def _unknown(self, count: int) -> Array:
        readings = self.recording.readings
        if readings is None:
            return np.zeros((count, 0))
        return (readings.unknowns / readings.noise_std[:, None]).reshape(count, -1)

    @property
    def unknowns(self) -> int:
        """How many numbers aren't known and no gap: the first columns of every background."""
        return UNKNOWNS + self.unknown.shape[1]

    def _add(self, name: str, bag: BagData) -> _Part:
        tool = self.recording.tool
        scene = Scene(
            bag=name,
            start_s=bag.start_s,
            joint_s=bag.joint_s,
            joints=bag.joints,
            wrench_s=bag.wrench_s,
            reading=bag.wrenches - tool.residual_offset,
            touched=np.zeros(len(bag.wrench_s), dtype=bool),
            tracker_s=bag.tool_marker.at_s if bag.tool_marker is not None else np.zeros(0),
            tool=ToolGeometry(tool.load.load, np.asarray(tool.tip_m, dtype=float)),
            adapter=tool.adapter.load,
            zero_pose_rad=tuple(tool.zero_angles),
            arm=self.recording.arm,
            inertia_kg_m2=self.recording.inertia_kg_m2,
            nominal=self.recording.nominal_effects,
        )
        if bag.readings is not None:
            return self._add_readings(bag, bag.readings, scene)
        of = phases(self.recording.arm, bag.wrench_s, bag.joint_s, bag.joints)
        residual = scene.reading - Replay(scene).reading()
        regime = moving_regime(scene.arm, of)
        if name == "push":
            rough = np.median(np.abs(np.diff(residual, axis=0)), axis=0) / (0.6745 * np.sqrt(2.0))
            scene = replace(scene, touched=touched(bag.wrench_s, of, residual, rough))
            force = np.linalg.norm(residual[:, :3], axis=1)
            pushes = push_regime(bag.wrench_s, force, scene.touched)
            regime = np.where(of.still, pushes, regime)
        at_rest = ~scene.touched
        # Quick moves turn a gap into what looks like coloured noise; rest doesn't.
        quiet = at_rest & of.still if (at_rest & of.still).sum() >= _QUIET else at_rest
        noise = channel_noise(
            stretches(bag.wrench_s, residual, of.stretch, quiet), _KNOT_S[name], 1e-6
        )
        if not noise:
            raise GalenError(
                f"{self.recording.name}/{name}: the arm never stays or moves long enough without a "
                "gap in the wrenches to show their noise"
            )
        noise = [_at_least(one, floor) for one, floor in zip(noise, LEAST_NOISE, strict=True)]
        self.noise[name] = noise
        shown = np.where(at_rest[:, None], residual, np.nan)
        self._stream(name, WRENCH_AXES, bag.wrench_s, shown, noise)
        stretch = of.stretch * 2 + scene.touched
        length_s = np.where(scene.touched, _TOUCHED_GROUP_S, _GROUP_S[name])
        groups = groups_of(bag.wrench_s, stretch, length_s, max(n.order for n in noise))
        white, gain = whitened(residual, noise, stretch, groups)
        shows = group_mean(groups, at_rest.astype(float)) > 0.5
        parts = [(_whereabouts(bag, bag.wrench_s, of, regime, groups, shows, 0, noise),
                  white[shows].ravel())]  # fmt: skip
        nothing = np.zeros((0, 6))
        thin = replace(
            scene,
            wrench_s=groups.at_s,
            reading=group_mean(groups, scene.reading),
            touched=group_mean(groups, scene.touched.astype(float)) > 0.5,
            tracker_s=np.zeros(0),
        )
        gains = (gain[shows], nothing, nothing)
        lead = _led(groups.at_s, noise, bag.wrench_s)
        leads: tuple[Between | None, Between | None, Between | None] = (lead, None, None)
        if bag.tool_marker is not None and bag.base_marker is not None:
            tracker_s, tip, marker, more = self._track(bag, scene, regime)
            thin = replace(thin, tracker_s=tracker_s)
            gains = (gain[shows], tip[0], marker[0])
            leads = (lead, tip[1], marker[1])
            parts += more
        self.views[name] = BagView(thin, shows, gains, leads)
        return _joined(parts)

    def _add_readings(self, bag: BagData, known: Readings, scene: Scene) -> _Part:
        """Take each reading for itself, with the noise that is known of it."""
        count = len(bag.wrench_s)
        still, each = np.ones(count, dtype=bool), np.arange(count)
        nothing = np.zeros_like(bag.joints)
        of = Phases(each, still, known.block, nothing, nothing)
        noise = [ChannelNoise(np.zeros(0), float(std)) for std in known.noise_std]
        groups = Groups(each, bag.wrench_s, np.ones(count, dtype=int))
        gain = np.tile(1.0 / known.noise_std, (count, 1))
        self.noise[bag.name] = noise
        none = np.zeros((0, 6))
        self.views[bag.name] = BagView(scene, still, (gain, none, none), (None, None, None))
        rows = _whereabouts(bag, bag.wrench_s, of, np.zeros(count, int), groups, still, 0, noise)
        rows["block"] = np.repeat(known.block, 6)
        residual = scene.reading - Replay(scene).reading()
        return rows, (gain * residual).ravel()

    def _track(
        self, bag: BagData, scene: Scene, regime: np.ndarray
    ) -> tuple[Array, tuple[Array, Between | None], tuple[Array, Between | None], list[_Part]]:
        """Return times of the tracker's groups, gains and leads of tip and marker, their rows."""
        tool, base = bag.tool_marker, bag.base_marker
        assert tool is not None
        assert base is not None
        at_s = tool.at_s
        nearest = np.clip(np.searchsorted(bag.wrench_s, at_s), 0, len(bag.wrench_s) - 1)
        of = phases(scene.arm, at_s, bag.joint_s, bag.joints)
        rotation, position = Replay(scene).tip()
        if self.base_in_tracker is None:
            rest = of.still & ~scene.touched[nearest]
            self.base_in_tracker = _registered(tool, rotation, position, rest)
        there = self.base_in_tracker
        back = there.rotation.T
        off = np.concatenate(
            [
                (tool.position - there.translation) @ back.T - position,
                matrix_to_rotvec(back @ tool.rotation @ np.swapaxes(rotation, -1, -2)),
            ],
            axis=1,
        )
        marker = _marker_displacement(base, there, at_s)
        off[~of.still] = np.nan  # in motion the tracker's own delay shows more than the arm
        # Under a push the tip shows what springs, gaps and delays do, and no noise alone.
        untouched = of.still & ~scene.touched[nearest]
        quiet = untouched if untouched.sum() >= _QUIET_TRACKS else of.still
        runs = of.stretch * 2 + scene.touched[nearest]
        still_runs = stretches(at_s, off, runs, quiet)
        whole = stretches(at_s, marker, np.zeros(len(at_s), int), np.ones(len(at_s), bool))
        tip_noise = channel_noise(still_runs, _TRACK_KNOT_S, 1e-7) or _USUAL_TRACKER_NOISE
        marker_noise = channel_noise(whole, _REST_KNOT_S, 1e-7) or _USUAL_TRACKER_NOISE
        order = max(n.order for n in (*tip_noise, *marker_noise))
        groups = groups_of(at_s, of.stretch, np.full(len(at_s), _TRACK_GROUP_S), order)
        regime_at = np.where(of.still, regime[nearest], moving_regime(scene.arm, of))
        everything = np.ones(len(groups.at_s), dtype=bool)
        gains, parts = [], []
        for axes, first, values, noise in (
            (TIP_AXES, 6, off, tip_noise),
            (MARKER_AXES, 12, marker, marker_noise),
        ):
            self._stream(bag.name, axes, at_s, values, noise)
            white, gain = whitened(values, noise, of.stretch, groups)
            # Rows without a value weigh nothing; the shapes stay simple.
            dead = ~np.isfinite(white)
            white[dead], gain[dead] = 0.0, 0.0
            gains.append((gain, _led(groups.at_s, noise, at_s)))
            rows = _whereabouts(bag, at_s, of, regime_at, groups, everything, first, noise)
            parts.append((rows, white.ravel()))
        return groups.at_s, gains[0], gains[1], parts

    def _stream(
        self,
        bag: str,
        channels: tuple[str, ...],
        at_s: Array,
        residual: Array,
        noise: list[ChannelNoise],
    ) -> None:
        std = np.array([one.std for one in noise])
        self.streams.append(Stream(bag, channels, at_s, residual, std, tuple(noise)))


def _joined(parts: Sequence[_Part]) -> _Part:
    rows = {key: np.concatenate([one[key] for one, _ in parts]) for key in parts[0][0]}
    return rows, np.concatenate([values for _, values in parts])


def _whereabouts(
    bag: BagData,
    at_s: Array,
    of: Phases,
    regime: np.ndarray,
    groups: Groups,
    shows: np.ndarray,
    first_channel: int,
    noise: list[ChannelNoise],
) -> dict[str, np.ndarray]:
    """Of each group shown where it is, six rows, one a channel."""
    central = middle(groups)
    per_group = {
        "bag": np.full(len(groups.at_s), BAGS.index(bag.name)),
        "regime": regime[central],
        "bag_s": groups.at_s,
        "session_s": groups.at_s + bag.start_s,
        "pose": of.pose[central],
        "block": blocks(bag.name, at_s, of.pose)[central],
        "joints": _at(groups.at_s, bag.joint_s, bag.joints),
        "rate": of.rate[central],
        "samples": groups.count,
    }
    rows = {key: np.repeat(value[shows], 6, axis=0) for key, value in per_group.items()}
    count = int(shows.sum())
    rows["channel"] = np.tile(np.arange(first_channel, first_channel + 6), count)
    std = np.array([1.0 / one.gain for one in noise])
    rows["scale"] = np.tile(std, count) / np.sqrt(rows["samples"])
    return rows


def _at(at_s: Array, known_s: Array, values: Array) -> Array:
    return np.stack([np.interp(at_s, known_s, column) for column in values.T], axis=1)


def _led(at_s: Array, noise: Sequence[ChannelNoise], sample_s: Array) -> Between | None:
    """Return values at times at_s (n,) as they are when whitening lets them show, by channel."""
    step_s = float(np.median(np.diff(sample_s))) if len(sample_s) > 1 else 0.0
    lead_s = np.array([one.lead_s(step_s) for one in noise])
    if not np.any(lead_s) or not len(at_s):
        return None
    return Between(at_s[:, None] + lead_s, at_s)


_SMALL_RAD = 0.5


def _rotvec(matrix: Array) -> Array:
    """`matrix_to_rotvec` (n, 3) of turns (n, 3, 3) that are mostly small, ten times as fast.

    Of a turn by theta, half of R - R^T is sin(theta) times the axis: exact to rounding where theta
    is far from pi / 2.
    """
    m = matrix
    axis = 0.5 * np.stack(
        [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=1
    )
    sine = np.sqrt(np.einsum("ni,ni->n", axis, axis))
    cosine = 0.5 * (np.einsum("nii->n", m) - 1.0)
    if np.any(cosine < np.cos(_SMALL_RAD)):
        return matrix_to_rotvec(matrix)
    return np.asarray(axis * (np.arcsin(sine) / np.where(sine > 0.0, sine, 1.0))[:, None])


def _at_least(noise: ChannelNoise, floor: float) -> ChannelNoise:
    return noise if noise.innovation >= floor else ChannelNoise(np.zeros(0), floor)


def _registered(tool: Track, rotation: Array, position: Array, rest: np.ndarray) -> Transform:
    """base_link in the tracker, from where the joints say that the untouched tip is."""
    use = rest if rest.sum() >= 10 else np.ones(len(tool), dtype=bool)
    marker = Transform(tool.rotation[use], tool.position[use])
    # W M = F with W the tracker in base_link.
    return solve_base(marker, Transform(rotation[use], position[use])).inverse()


def _marker_displacement(base: Track, there: Transform, at_s: Array) -> Array:
    """Displacement (n, 6) of the base's marker from its median, in base_link, at times at_s."""
    nearest = np.clip(np.searchsorted(base.at_s, at_s), 0, len(base) - 1)
    mean = np.median(base.position, axis=0)
    first = base.rotation[len(base) // 2]
    turns = matrix_to_rotvec(base.rotation @ first.T)
    turns = turns - np.median(turns, axis=0)
    both = np.concatenate([(base.position - mean) @ there.rotation, turns @ there.rotation], axis=1)
    return both[nearest]
