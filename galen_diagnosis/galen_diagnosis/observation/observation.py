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
from galen_model.load.nominal_tools import ToolGeometry
from galen_model.registration import Transform, solve_base
from galen_model.rotation import matrix_to_rotvec, rotvec_to_matrix
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.replay import Replay, Scene

from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.observation.noise import ChannelNoise, channel_noise
from galen_diagnosis.observation.phases import (
    Phases,
    blocks,
    deal,
    moving_regime,
    phases,
    push_regime,
    touched,
)
from galen_diagnosis.observation.recording import BagData, Recording, Track
from galen_diagnosis.observation.rows import (
    BAGS,
    CHANNELS,
    MARKER_AXES,
    TIP_AXES,
    Groups,
    Rows,
    Stream,
    group_mean,
    groups_of,
    middle,
    stretches,
    whitened,
)

_GROUP_S = {"sweep": 0.1, "motion": 0.025, "push": 0.1}
_TRACK_GROUP_S = 0.05
_KNOT_S = {"sweep": 5.0, "motion": 0.4, "push": 5.0}
_REST_KNOT_S = 5.0
_QUIET = 500
_TRACK_KNOT_S = 0.4
_LEAST_NOISE = np.array([1e-4] * 3 + [1e-6] * 3 + [1e-7] * 12)
_USUAL_TRACKER_NOISE = [
    *[ChannelNoise(np.zeros(0), 3e-5)] * 3,
    *[ChannelNoise(np.zeros(0), 1e-4)] * 3,
]
"""Of a tracker whose own noise can't be told: m, rad."""
UNKNOWNS = 18


@dataclass(frozen=True)
class Unknowns:
    """What isn't known and no gap.

    offset (6,): of the reading, N and N.m. base (6,): how base_link is displaced in the tracker
    from the observation's first estimate, along base_link: m, rad. marker (6,): displacement of the
    base's marker from its mean.
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
        return self.values[12:]


@dataclass(frozen=True)
class BagView:
    """One bag's thinned scene, and how its rows lie.

    scene: at the groups' mean times. shows (nw,): groups whose wrench is scored. wrench_gain
    (nw, 6), tip_gain, marker_gain (nt, 6): what a constant change of the prediction becomes.
    """

    scene: Scene
    shows: np.ndarray
    wrench_gain: Array
    tip_gain: Array
    marker_gain: Array

    @property
    def tracks(self) -> bool:
        """Whether the tracker was on."""
        return len(self.tip_gain) > 0


class Observation:
    """What was measured, as rows; `residual` gives them under effects and unknowns."""

    def __init__(self, recording: Recording) -> None:
        """Whiten with the noise of the nominal residual; raises DiagnosisError for too little."""
        self.recording = recording
        self.base_in_tracker: Transform | None = None
        self.views: dict[str, BagView] = {}
        self.streams: list[Stream] = []
        self.noise: dict[str, list[ChannelNoise]] = {}
        tool = recording.tool
        self._tool = ToolGeometry(tool.load.load, np.asarray(tool.tip_m, dtype=float))
        meta: list[dict[str, np.ndarray]] = []
        parts: list[Array] = []
        first_block = 0
        for name, bag in recording.bags.items():
            rows, values, first_block = self._add(name, bag, first_block)
            meta.append(rows)
            parts.append(values)
        joined = {key: np.concatenate([part[key] for part in meta]) for key in meta[0]}
        self.rows = Rows(**joined)
        if first_block < 2:
            raise DiagnosisError(
                f"{recording.name}: one pose, or three seconds, is all there is; nothing is "
                "left to score a fit on"
            )
        self.nominal = np.concatenate(parts)
        self._none = {name: self._predictions(view, (), None) for name, view in self.views.items()}

    # --- what the simulator says ----------------------------------------------------------------

    def residual(
        self, effects: Sequence[Effect], unknowns: Unknowns | None = None, bags: Sequence[str] = ()
    ) -> Array:
        """Rows (N,) with the effects in the simulator; `bags`: only theirs change (default all)."""
        return self.nominal - self.change(effects, unknowns, bags)

    def change(
        self, effects: Sequence[Effect], unknowns: Unknowns | None = None, bags: Sequence[str] = ()
    ) -> Array:
        """What effects and unknowns add to the prediction, in the rows' units (N,)."""
        out = []
        for name, view in self.views.items():
            before = self._none[name]
            if bags and name not in bags:
                out.append(np.zeros(sum(part.size for part in _scored(view, before))))
                continue
            after = self._predictions(view, effects, unknowns)
            out += [
                (gain * _difference(new, old, kind)).ravel()
                for gain, new, old, kind in zip(
                    _gains(view),
                    _scored(view, after),
                    _scored(view, before),
                    ("wrench", "pose", "twist"),
                    strict=True,
                )
            ]
        return np.concatenate(out)

    def nominal_reading(self, name: str) -> Array:
        """What the nominal arm would read at a bag's wrench rows (nw, 6)."""
        return self._none[name][0][self.views[name].shows]

    def applied_load(self, name: str) -> tuple[Array, Array]:
        """Times (n,) and the hand's wrench (n, 6), as the nominal arm tells it; 0 untouched."""
        scene = self.views[name].scene
        load = scene.reading - self._none[name][0]
        return scene.wrench_s, np.where(scene.touched[:, None], load, 0.0)

    def streams_with(
        self, effects: Sequence[Effect], unknowns: Unknowns | None = None
    ) -> tuple[Stream, ...]:
        """The residual streams with effects and unknowns in the simulator."""
        out = []
        changes = {}
        for name, view in self.views.items():
            pairs = zip(self._predictions(view, effects, unknowns), self._none[name], strict=True)
            changes[name] = [
                _difference(new, old, kind)
                for (new, old), kind in zip(pairs, ("wrench", "pose", "twist"), strict=True)
            ]
        for stream in self.streams:
            wrench, tip, marker = changes[stream.bag]
            scene = self.views[stream.bag].scene
            known_s, change = {
                WRENCH_AXES[0]: (scene.wrench_s, wrench),
                TIP_AXES[0]: (scene.tracker_s, tip),
                MARKER_AXES[0]: (scene.tracker_s, marker),
            }[stream.channels[0]]
            there = np.stack(
                [np.interp(stream.at_s, known_s, column) for column in change.T], axis=1
            )
            out.append(replace(stream, residual=stream.residual - there))
        return tuple(out)

    def _predictions(
        self, view: BagView, effects: Sequence[Effect], unknowns: Unknowns | None
    ) -> tuple[Array, Array, Array]:
        """Wrench (nw, 6), tip in base_link as (nt, 12) (position, rotation matrix), marker (nt, 6).

        The tip is what the tracker tells, seen from where base_link was first estimated to be.
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

    # --- building -------------------------------------------------------------------------------

    def _add(
        self, name: str, bag: BagData, first_block: int
    ) -> tuple[dict[str, np.ndarray], Array, int]:
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
            tool=self._tool,
            adapter=tool.adapter.load,
            zero_pose_rad=tuple(tool.zero_angles),
        )
        of = phases(bag.wrench_s, bag.joint_s, bag.joints)
        residual = scene.reading - Replay(scene).reading()
        is_touched = np.zeros(len(residual), dtype=bool)
        if name == "push":
            rough = np.median(np.abs(np.diff(residual, axis=0)), axis=0) / (0.6745 * np.sqrt(2.0))
            is_touched = touched(bag.wrench_s, of, residual, rough)
            scene = replace(scene, touched=is_touched)
        at_rest = ~is_touched
        # Quick moves turn a gap into what looks like coloured noise; rest doesn't.
        quiet = at_rest & of.still if (at_rest & of.still).sum() >= _QUIET else at_rest
        noise = channel_noise(
            stretches(bag.wrench_s, residual, of.stretch, quiet), _KNOT_S[name], 1e-6
        )
        if not noise:
            raise DiagnosisError(
                f"{self.recording.name}/{name}: the arm never stays or moves long enough without a "
                "gap in the wrenches to tell their noise"
            )
        noise = [_at_least(one, floor) for one, floor in zip(noise, _LEAST_NOISE, strict=False)]
        stretch = of.stretch * 2 + is_touched
        groups = groups_of(bag.wrench_s, stretch, _GROUP_S[name], max(n.order for n in noise))
        white, gain = whitened(residual, noise, stretch, groups)
        shows = group_mean(groups, at_rest.astype(float)) > 0.5
        force = np.linalg.norm(residual[:, :3], axis=1)
        regime = moving_regime(of)
        if name == "push":
            regime = np.where(of.still, push_regime(bag.wrench_s, force, is_touched), regime)
        block = blocks(name, bag.wrench_s, of.pose)
        meta = self._meta(
            name, bag.start_s, groups, of, regime, block, bag.wrench_s, bag, shows, 0, noise
        )
        values = [white[shows].ravel()]
        thin = replace(
            scene,
            wrench_s=groups.at_s,
            reading=group_mean(groups, scene.reading),
            touched=group_mean(groups, is_touched.astype(float)) > 0.5,
            tracker_s=np.zeros(0),
        )
        shown = np.where(at_rest[:, None], residual, np.nan)
        self.streams.append(
            Stream(
                name,
                WRENCH_AXES,
                bag.wrench_s,
                shown,
                np.array([n.std for n in noise]),
                tuple(noise),
            )
        )
        self.noise[name] = noise
        tip_gain = marker_gain = np.zeros((0, 6))
        metas = [meta]
        if bag.tool_marker is not None and bag.base_marker is not None:
            tracked = self._track(name, bag, scene, of, is_touched, regime, force)
            thin = replace(thin, tracker_s=tracked[0].at_s)
            tip_gain, marker_gain = tracked[1], tracked[2]
            values += tracked[3]
            metas += tracked[4]
        self.views[name] = BagView(thin, shows, gain[shows], tip_gain, marker_gain)
        joined = {key: np.concatenate([part[key] for part in metas]) for key in metas[0]}
        numbers, block = np.unique(joined["block"], return_inverse=True)
        joined["block"] = block + first_block
        joined["fold"] = deal(len(numbers), BAGS.index(name))[block]
        return joined, np.concatenate(values), first_block + len(numbers)

    def _track(
        self,
        name: str,
        bag: BagData,
        scene: Scene,
        of: Phases,
        is_touched: np.ndarray,
        regime: np.ndarray,
        force: Array,
    ) -> tuple[Groups, Array, Array, list[Array], list[dict[str, np.ndarray]]]:
        tool, base = bag.tool_marker, bag.base_marker
        assert tool is not None
        assert base is not None
        at_s = tool.at_s
        nearest = np.clip(np.searchsorted(bag.wrench_s, at_s), 0, len(bag.wrench_s) - 1)
        of_track = phases(at_s, bag.joint_s, bag.joints)
        rest = of_track.still & ~is_touched[nearest]
        rotation, position = Replay(scene).tip()
        if self.base_in_tracker is None:
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
        moves = ~of_track.still
        off[moves] = np.nan  # in motion the tracker's own delay says more than the arm
        tip_noise = (
            channel_noise(
                stretches(at_s, off, of_track.stretch, of_track.still), _TRACK_KNOT_S, 1e-7
            )
            or _USUAL_TRACKER_NOISE
        )
        marker_noise = (
            channel_noise(
                stretches(at_s, marker, np.zeros(len(at_s), int), np.ones(len(at_s), bool)),
                _REST_KNOT_S,
                1e-7,
            )
            or _USUAL_TRACKER_NOISE
        )
        stretch = of_track.stretch
        order = max(n.order for n in (*tip_noise, *marker_noise))
        groups = groups_of(at_s, stretch, _TRACK_GROUP_S, order)
        tip_white, tip_gain = whitened(off, tip_noise, stretch, groups)
        marker_white, marker_gain = whitened(marker, marker_noise, stretch, groups)
        # Rows that say nothing weigh nothing; the shapes stay simple.
        for white, gain in ((tip_white, tip_gain), (marker_white, marker_gain)):
            dead = ~np.isfinite(white)
            white[dead], gain[dead] = 0.0, 0.0
        names = [(*TIP_AXES,), (*MARKER_AXES,)]
        for axes, values, noise in (
            (names[0], off, tip_noise),
            (names[1], marker, marker_noise),
        ):
            std = np.array([n.std for n in noise])
            self.streams.append(Stream(name, axes, at_s, values, std, tuple(noise)))
        regime_at = np.where(of_track.still, regime[nearest], moving_regime(of_track))
        block = blocks(name, at_s, of_track.pose)
        everything = np.ones(len(groups.at_s), dtype=bool)
        metas = [
            self._meta(
                name,
                bag.start_s,
                groups,
                of_track,
                regime_at,
                block,
                at_s,
                bag,
                everything,
                first,
                noise,
            )
            for first, noise in ((6, tip_noise), (12, marker_noise))
        ]
        return groups, tip_gain, marker_gain, [tip_white.ravel(), marker_white.ravel()], metas

    def _meta(
        self,
        name: str,
        start_s: float,
        groups: Groups,
        of: Phases,
        regime: np.ndarray,
        block: np.ndarray,
        at_s: Array,
        bag: BagData,
        shows: np.ndarray,
        first_channel: int,
        noise: list[ChannelNoise],
    ) -> dict[str, np.ndarray]:
        """Rows' whereabouts: of each group shown, six rows, one a channel."""
        central = middle(groups)
        joints = np.stack(
            [np.interp(groups.at_s, bag.joint_s, column) for column in bag.joints.T], axis=1
        )
        per_group = {
            "bag": np.full(len(groups.at_s), BAGS.index(name)),
            "regime": regime[central],
            "bag_s": groups.at_s,
            "session_s": groups.at_s + start_s,
            "pose": of.pose[central],
            "block": block[central],
            "fold": np.zeros(len(groups.at_s), dtype=int),
            "joints": joints,
            "rate": of.rate[central],
            "samples": groups.count,
        }
        rows = {key: np.repeat(value[shows], 6, axis=0) for key, value in per_group.items()}
        count = int(shows.sum())
        rows["channel"] = np.tile(np.arange(first_channel, first_channel + 6), count)
        std = np.array([1.0 / n.gain for n in noise])
        rows["scale"] = np.tile(std, count) / np.sqrt(rows["samples"])
        assert rows["channel"].max(initial=0) < len(CHANNELS)
        return rows


# --- inside -------------------------------------------------------------------------------------


def _scored(view: BagView, predictions: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    wrench, tip, marker = predictions
    return wrench[view.shows], tip, marker


def _gains(view: BagView) -> tuple[Array, Array, Array]:
    return view.wrench_gain, view.tip_gain, view.marker_gain


def _difference(new: Array, old: Array, kind: str) -> Array:
    if kind != "pose" or not len(new):
        return (new - old)[:, :6] if kind == "pose" else new - old
    turned = new[:, 3:].reshape(-1, 3, 3) @ np.swapaxes(old[:, 3:].reshape(-1, 3, 3), -1, -2)
    return np.concatenate([new[:, :3] - old[:, :3], matrix_to_rotvec(turned)], axis=1)


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
