"""The forms in which each effect is tried on a recording, and the background of every fit.

A candidate is an effect with everything chosen that isn't a number to fit (which axis, which joint,
where a cable is held), the numbers to fit, where a fit starts and how large they usually are. An
effect is likely as a whole: its forms share its probability.

Beside every hypothesis are fitted unknowns that are no gap, and a healthy arm's tolerances: no arm
is the nominal one to the last micrometre. Its joints' zeros, its sensor's gains, its tool's file
are right within what workshops and calibrations reach; a gap is what lies beyond.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.hysteresis import DeflectionHysteresis
from galen_sim_driver.effects.joints import CROSSINGS, Backlash, JointAxisMisalignment
from galen_sim_driver.effects.load import CableDrag
from galen_sim_driver.effects.registry import identities
from galen_sim_driver.effects.sensor import Crosstalk

from galen_diagnosis.effects.general_shapes import ForceField, FrictionInJoints
from galen_diagnosis.observation.observation import UNKNOWNS, Observation, Unknowns
from galen_diagnosis.observation.rows import CHANNELS, TIP_AXES

NEEDS_TRACKER = frozenset(
    {
        "joint_compliance",
        "deflection_hysteresis",
        "tracker_delay",
        "tracker_scale",
        "base_shift",
    }
)
"""Effects that only the tracker sees."""

NEEDS_MOTION = frozenset({"wrench_delay", "inertial_load"})
"""Effects that only a moving arm shows."""

_SCANNED = frozenset({"crosstalk", "sensor_drift", "bias_step", "base_shift", "sensor_saturation"})
"""Effects whose forms are made by `scans.py`."""

_NOT_ON_THE_GALEN = frozenset({"joint_gain:roll", "joint_axis_misalignment:roll"})
"""Effects at joints where the calibration of the probabilities has none of them."""

_CABLE_REACH_M = 0.7
"""How far from the tool a cable's other end is taken to be where its fit begins."""
_ALL = "all"
_FRICTIONS = {"tip": "Bouc and Wen, at the tip", "joints": "Dahl, in the joints"}
_CROSSED = {"stiction": "gap with stiction", "centred": "gap", "soft": "soft gap"}
_WIDTHS = {"stiction": 2.0, "centred": 0.5}
_ALONG = 0.9
"""Cosine between two axes from which on they are taken for one."""


def sought(arm: Arm) -> dict[str, Effect]:
    """Return what is looked for on an arm, by identity: effects that change nothing yet."""
    left_out = _NOT_ON_THE_GALEN if _is_galen(arm) else frozenset()
    return {name: effect for name, effect in identities(arm).items() if name not in left_out}


def _is_galen(arm: Arm) -> bool:
    return arm.joint_names == GALEN.joint_names


EffectsAt = Callable[[Array], Sequence[Effect]]


@dataclass(frozen=True)
class Candidate:
    """An effect in one form; `base` holds all of it but the free numbers.

    effect: its identity (`Effect.identity`), which of a joint's effects has the joint. free (p,):
    which of the effect's `vector` are fitted. start (p,): nothing or next to nothing is changed.
    typical (p,): prior standard deviations about it. probe (p,): steps of finite differences.
    columns (N, p): how the prediction changes, where that is known and linear. make: the effect
    with other numbers, where that isn't a matter of `vector`. inputs: the numbers are unknown loads
    beside the effect, which no simulator knows. linear: how many of the numbers, the first ones, do
    anything at the start, None for all. known: parameters whose interval isn't the fit's.
    bonus: log evidence for the form that isn't in the rows. model: which of the effect's, in words,
    where it has several. into: the candidate that a fit takes in
    its place, and where it begins, of the linear answer (p,).
    """

    effect: str
    label: str
    base: Effect
    free: np.ndarray
    start: Array
    typical: Array
    probe: Array
    columns: Array | None = None
    make: Callable[[Array], Effect] | None = None
    inputs: bool = False
    linear: int | None = None
    known: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    bonus: float = 0.0
    model: str = ""
    into: Callable[[Array], tuple[Candidate, Array]] | None = None

    @property
    def key(self) -> tuple[str, str]:
        """By which its columns are found."""
        return self.effect, self.label

    def unsimulated(self, values: Array) -> Array | float:
        """Return what these numbers add to the rows' prediction that no simulator knows (N,)."""
        if not self.inputs or self.columns is None:
            return 0.0
        return np.asarray(self.columns @ values)

    def jacobian(self, observation: Observation, effects: EffectsAt, values: Array) -> Array:
        """Return how the rows' prediction changes (N, p) by the numbers.

        effects(values): all of a hypothesis' effects with these numbers of this one.
        """
        if self.columns is not None:
            return self.columns
        here = observation.change(effects(values))
        columns = np.empty((len(here), len(values)))
        for k, step in enumerate(self.probe):
            moved = values.copy()
            moved[k] += step
            columns[:, k] = (observation.change(effects(moved)) - here) / step
        return columns

    def limits(self) -> tuple[Array, Array]:
        """Return the lowest and highest value of each free number."""
        if self.make is not None:
            return np.full(len(self.start), -np.inf), np.full(len(self.start), np.inf)
        low, high = _bounds(self.base)
        return low[self.free], high[self.free]

    def at(self, values: Array) -> Effect:
        """Return the effect with these numbers (p,), kept within its bounds."""
        if self.make is not None:
            return self.make(values)
        vector = self.base.vector()
        vector[self.free] = values
        return self.base.with_vector(np.clip(vector, *_bounds(self.base)))


def _bounds(effect: Effect) -> tuple[Array, Array]:
    low = np.concatenate([np.full(p.size, p.lower) for p in effect.fitted])
    high = np.concatenate([np.full(p.size, p.upper) for p in effect.fitted])
    return low, high


def candidates(observation: Observation) -> list[Candidate]:
    """Return all forms that the recording could show, but for those of `scans.py`."""
    tracker = any(view.tracks for view in observation.views.values())
    moves = bool(np.any(np.abs(observation.rows.rate) > 0.05))
    found = []
    for name, effect in sought(observation.recording.arm).items():
        if name in _SCANNED or (name in NEEDS_TRACKER and not tracker):
            continue
        if name in NEEDS_MOTION and not moves:
            continue
        special = _FORMS.get(effect.name)
        if special is not None:
            found += list(special(observation, effect))
        else:
            found.append(_plain(name, "", effect, np.arange(len(effect.vector()))))
    return found


def crosstalks() -> list[tuple[str, str, Crosstalk]]:
    """Return all pairs of axes: from, to, effect."""
    return [(a, b, Crosstalk(from_axis=a, to_axis=b)) for a, b in permutations(WRENCH_AXES, 2)]


def crosstalk_candidate(effect: Crosstalk) -> Candidate:
    """Return the form of one pair; coefficients between force and torque have a metre in them."""
    metre = 0.1
    size = 0.03
    if (effect.from_axis[0] == "f") != (effect.to_axis[0] == "f"):
        size = size * metre if effect.to_axis[0] == "t" else size / metre
    label = f"{effect.from_axis} to {effect.to_axis}"
    one = _plain("crosstalk", label, effect, np.arange(1))
    return replace(one, typical=np.array([size]), probe=np.array([0.1 * size]))


def _plain(name: str, label: str, effect: Effect, free: np.ndarray) -> Candidate:
    typical = np.concatenate([p.typicals for p in effect.fitted])[free]
    start = effect.vector()[free]
    return Candidate(name, label, effect, free, start, typical, 0.05 * typical)


def _compliances(_: Observation, effect: Effect) -> Iterator[Candidate]:
    for index, spring in enumerate(effect.fitted):
        name = spring.name.removeprefix("softness_")
        one = _plain("joint_compliance", name, effect, np.array([index]))
        # Of exactly 0 the effect keeps the spring nominal, and a fit can't leave it.
        yield replace(one, probe=np.array([0.05]))
    count = len(effect.fitted)
    every = _plain("joint_compliance", _ALL, effect, np.arange(count))
    yield replace(every, probe=np.full(count, 0.05))


def _misalignments(observation: Observation, effect: Effect) -> Iterator[Candidate]:
    """Yield a turn about each axis of the parent link; about the joint's own it is no turn."""
    assert isinstance(effect, JointAxisMisalignment)
    arm = observation.recording.arm
    if _is_galen(arm):  # its tilt axis turned about x is the roll's zero
        yield _plain(effect.identity, "", effect, np.arange(1))
        return
    joint = arm.joints[effect.index]
    axis = joint.axis if joint.rotation is None else joint.rotation @ joint.axis
    for about, along in zip("xyz", np.abs(axis), strict=True):
        if along < _ALONG:
            yield _plain(effect.identity, about, replace(effect, about=about), np.arange(1))


def _hysteresis(observation: Observation, _: Effect) -> Iterator[Candidate]:
    for form, knee, restarts in (
        ("tip", 0.08, True),
        ("tip", 0.3, True),
        ("tip", 1.0, True),
        ("tip", 0.3, False),
        ("joints", 0.2, True),
    ):
        effect = DeflectionHysteresis(form=form, knee=knee, restarts=restarts)
        free = np.arange(3) if form == "tip" else np.arange(1)
        kept = "" if restarts else " kept"
        one = _plain("deflection_hysteresis", f"{form} {knee:g}{kept}", effect, free)
        probe = np.array([0.02, 0.05 * knee, 0.02])[free]
        typical = np.array([0.1, 0.5 * knee, 0.05])[free]
        yield replace(one, probe=probe, typical=typical, model=_FRICTIONS[form])
    recording = observation.recording
    none = FrictionInJoints.of(recording.arm, np.asarray(recording.tool.tip_m))
    if none.plays:
        yield _friction(observation, none)


def _friction(observation: Observation, none: FrictionInJoints) -> Candidate:
    """Return dry friction in each joint; which joints, and where fits begin, is linear."""
    count = len(none.weights)
    one = Candidate(
        *("deflection_hysteresis", "in joints", none, np.arange(count), np.zeros(count)),
        *(np.full(count, 0.3), np.ones(count)),
        make=lambda values: replace(none, weights=_floats(values)),
    )
    unit = [observation.change([one.at(row)]) for row in np.eye(count)]

    def joined(values: Array) -> tuple[Candidate, Array]:
        begin = replace(none, weights=_floats(values)).joined()
        count = len(begin.weights)
        start = np.concatenate([np.zeros(count), np.log(begin.thresholds)])
        fitted = Candidate(
            *("deflection_hysteresis", "in joints", begin, np.arange(2 * count), start),
            typical=np.repeat([0.3, 0.5], count),
            probe=np.repeat([0.1, 0.05], count),
            model="dry friction in each joint",
            make=lambda own: begin.of_numbers(own[:count], np.exp(np.clip(own[count:], -9.0, 9.0))),
        )
        return fitted, np.concatenate([begin.weights, start[count:]])

    return replace(one, columns=np.stack(unit, axis=1), into=joined)


def _backlashes(observation: Observation, effect: Effect) -> Iterator[Candidate]:
    assert isinstance(effect, Backlash)
    # With no gap the other numbers do nothing: they come in with the fit on the simulator.
    for joint, crossing in product(observation.recording.arm.turning_names, CROSSINGS):
        seat, width = (4.0, effect.width) if crossing == "soft" else (2.0, _WIDTHS[crossing])
        start = effect.start if crossing == "stiction" else 0.0
        base = replace(effect, joint=joint, seat=seat, width=width, start=start, crossing=crossing)
        count = 3 if crossing == "soft" else 4
        one = _plain("backlash", f"{joint} {crossing}", base, np.arange(count))
        probe = np.array([1e-3, 0.05, 0.1, 0.02])[:count]
        yield replace(one, probe=probe, linear=1, model=_CROSSED[crossing])


def _cables(observation: Observation, effect: Effect) -> Iterator[Candidate]:
    """Yield fields of forces, as of a hose or a hanging cable, and a taut cable.

    How likely a taut cable is linearly, and where its fit begins, follow from the field.
    """
    assert isinstance(effect, CableDrag)
    rotation, origin = observation.sensor_poses(2000)
    at = np.mean(origin + rotation @ np.asarray(effect.attachment_m), axis=0)
    none = ForceField(attachment_m=effect.attachment_m, at_m=_floats(at))
    field_ = _plain("cable_drag", "field", none, np.array([*range(9), *range(19, 22)]))
    curved = _plain("cable_drag", "curved field", none, np.arange(22))
    yield replace(field_, linear=9, model="elastic force, linear in the tool's place")
    yield replace(curved, linear=19, model="elastic force, quadratic in the tool's place")

    def cable(values: Array) -> tuple[Candidate, Array]:
        pull = values[:3]
        tension = float(np.linalg.norm(pull))
        anchor = at + _CABLE_REACH_M * pull / max(tension, 1e-9)
        here = replace(effect, tension_n=0.0, anchor_m=_floats(anchor), reference_m=_floats(at))
        fitted = _plain("cable_drag", "taut", here, np.arange(9))
        probe = np.array([0.05, *[0.02] * 3, *[0.005] * 3, 0.1, 1e-3])
        typical = np.array([0.3, *[0.4] * 3, *[0.06] * 3, 2.0, 0.01])
        begin = fitted.start.copy()
        begin[0] = tension
        return replace(fitted, probe=probe, typical=typical, model="taut cable"), begin

    yield replace(field_, label="taut", linear=9, into=cable)


def _floats(vector: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in vector)


_FORMS = {
    "joint_axis_misalignment": _misalignments,
    "joint_compliance": _compliances,
    "deflection_hysteresis": _hysteresis,
    "backlash": _backlashes,
    "cable_drag": _cables,
}

# Tolerances of a healthy arm


_GAIN = 0.3e-3
_ANGLE = 0.1e-3

TOLERANCES: Mapping[str, float | tuple[float, ...]] = {
    # A level and a dial gauge set a joint's zero and the base to 0.1 ... 0.2 mrad.
    "joint_zero_offset": _ANGLE,
    "joint_axis_misalignment": _ANGLE,
    "base_inclination": (_ANGLE, _ANGLE),
    "sensor_mount_rotation": (_ANGLE,) * 3,
    # An encoder's scale over its travel.
    "joint_gain": 0.1e-3,
    # The rest of a sensor's gains after its maker's matrix and an adjustment on the arm.
    "axis_gain": (_GAIN,) * 6,
    # Samples are stamped when they are read: within a fraction of a period of 2 to 10 ms.
    "wrench_delay": 0.3e-3,
    # A camera's exposure and way are known to a fraction of its period of 3 to 17 ms.
    "tracker_delay": 1.0e-3,
    "tracker_scale": 0.05e-3,
    # A tool seated in its mount.
    "loose_tool": 0.01e-3,
    # What a static test on the arm repeats.
    "joint_compliance": 0.5e-2,
}
"""Standard deviations of a healthy arm's parameters, by effect."""

_ZERO_N, _ZERO_NM = 0.1, 2e-3
"""How far the sensor's zero may lie off, beside what its drift makes of it."""

_PLACE_M, _PLACE_RAD = 0.05e-3, 0.08e-3
"""How well the joints tell where the tip is, from one place of the arm to another: its geometry."""

_MASS_KG, _COM_M = 0.1e-3, 0.1e-3
"""What a tool's file may be off at most and still be right, however unsure it says it is itself."""


def unknown_columns(observation: Observation) -> Array:
    """Return how the prediction changes (N, 18) by each of `Unknowns`."""
    steps = np.array([1e-2] * 3 + [1e-3] * 3 + [1e-4] * 6 + [1.0] * 6)
    columns = []
    for k, step in enumerate(steps):
        values = np.zeros(UNKNOWNS)
        values[k] = step
        columns.append(observation.change((), Unknowns(values)) / step)
    return np.stack(columns, axis=1)


def background(
    observation: Observation, unknowns: Array, columns: Mapping[tuple[str, str], Array]
) -> Background:
    """Join unknowns (N, 18), places of the arm, and tolerances among the candidates' columns.

    columns: by effect and form, (N, p) at nominal.
    """
    parts = [unknowns]
    std = [np.array([_ZERO_N] * 3 + [_ZERO_NM] * 3 + [np.inf] * 12)]
    places = _place_columns(observation)
    parts.append(places)
    std.append(np.tile([_PLACE_M] * 3 + [_PLACE_RAD] * 3, places.shape[1] // 6))
    for (effect, label), values in columns.items():
        size = tolerance(observation, effect, label)
        if size is not None:
            parts.append(values)
            std.append(np.atleast_1d(np.asarray(size, dtype=float)))
    return Background(np.concatenate(parts, axis=1), np.concatenate(std))


def tolerance(
    observation: Observation, identity: str, label: str
) -> float | Sequence[float] | None:
    """Return what a healthy arm's parameters may be off, by effect and form; None for no such."""
    load = observation.recording.tool.load
    if identity == "tool_mass_error":
        return max(min(float(load.mass_std_kg), _MASS_KG), 1e-6)
    if identity == "tool_com_error":
        return tuple(max(float(min(std, _COM_M)), 1e-6) for std in load.com_std_m)
    return None if label == _ALL else TOLERANCES.get(identity.partition(":")[0])


def _place_columns(observation: Observation) -> Array:
    """Rows of the tip at each place of the arm: (N, 6 places), in the rows' units."""
    rows = observation.rows
    first = CHANNELS.index(TIP_AXES[0])
    tip = (rows.channel >= first) & (rows.channel < first + 6)
    gain = np.zeros(len(rows))
    # A constant becomes sqrt(n) / sigma in a row of n samples: one over the row's scale.
    gain[tip] = 1.0 / rows.scale[tip]
    places = [number for number in np.unique(rows.pose[tip]) if number >= 0]
    columns = np.zeros((len(rows), 6 * len(places)))
    for k, place in enumerate(places):
        for axis in range(6):
            here = tip & (rows.pose == place) & (rows.channel == first + axis)
            columns[here, 6 * k + axis] = gain[here]
    return columns
