"""The forms in which each effect is tried on a recording.

A candidate is an effect with everything chosen that isn't a number to fit (which axis, which joint,
where a cable is held), the numbers to fit, where a fit starts and how large they usually are. An
effect is likely as a whole: its forms share its probability.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arm.kinematics import sensor_pose
from galen_model.arrays import Array
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.hysteresis import DeflectionHysteresis
from galen_sim_driver.effects.joints import Backlash, JointCompliance
from galen_sim_driver.effects.load import CableDrag
from galen_sim_driver.effects.registry import IDENTITIES
from galen_sim_driver.effects.sensor import Crosstalk

from galen_diagnosis.observation.observation import Observation

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

ELSEWHERE = frozenset({"crosstalk", "sensor_drift", "bias_step", "base_shift", "sensor_saturation"})
"""Effects whose forms are scanned (`scans.py`, `saturation.py`) instead of being listed here."""

NOT_SOUGHT = frozenset({"joint_gain:roll", "joint_axis_misalignment:roll"})
"""Effects at joints where the calibration of the probabilities has none of them."""

_CABLE_REACH_M = 0.7
_CABLE_WAYS = (1.0, float(np.sqrt(3.0)))
"""Held towards the faces and corners of a cube about the tool."""
_SOFTNESS = ("roll", "tilt", "carriage", "rod")


SOUGHT = {name: effect for name, effect in IDENTITIES.items() if name not in NOT_SOUGHT}
"""What is looked for, by identity: effects that change nothing yet."""

EffectsAt = Callable[[Array], Sequence[Effect]]


@dataclass(frozen=True)
class Candidate:
    """An effect in one form; `base` holds all of it but the free numbers.

    effect: its identity (`Effect.identity`), which of a joint's effects has the joint.
    free (p,): which of the effect's `vector` are fitted. start (p,): where nothing or next to
    nothing is changed. typical (p,): their prior's standard deviations about `centre` (p,).
    probe (p,): by how much to change each for a finite difference.
    """

    effect: str
    label: str
    base: Effect
    free: np.ndarray
    start: Array
    centre: Array
    typical: Array
    probe: Array

    def unsimulated(self, values: Array) -> Array | float:
        """What these numbers add to the rows' prediction that no simulator knows (N,)."""
        return 0.0

    @property
    def has_inputs(self) -> bool:
        """Whether its numbers are unknown inputs instead of the effect's own."""
        return False

    @property
    def other_evidence(self) -> float:
        """Log evidence for the form that isn't in the rows."""
        return 0.0

    def jacobian(self, observation: Observation, effects: EffectsAt, values: Array) -> Array:
        """How the rows' prediction changes (N, p) by the numbers, by differences.

        effects(values): all of a hypothesis' effects with these numbers of this one.
        """
        here = observation.change(effects(values))
        columns = np.empty((len(here), len(values)))
        for k, step in enumerate(self.probe):
            moved = values.copy()
            moved[k] += step
            columns[:, k] = (observation.change(effects(moved)) - here) / step
        return columns

    def limits(self) -> tuple[Array, Array]:
        """Lowest and highest value of each free number."""
        low, high = bounds(self.base)
        return low[self.free], high[self.free]

    def at(self, values: Array) -> Effect:
        """The effect with these numbers (p,), kept within what makes sense."""
        vector = self.base.vector()
        vector[self.free] = values
        low, high = bounds(self.base)
        return self.base.with_vector(np.clip(vector, low, high))


def bounds(effect: Effect) -> tuple[Array, Array]:
    """Lowest and highest value of each number of the effect's vector."""
    low = np.concatenate([np.full(p.size, p.lower) for p in effect.fitted])
    high = np.concatenate([np.full(p.size, p.upper) for p in effect.fitted])
    return low, high


def candidates(observation: Observation) -> list[Candidate]:
    """All forms that the recording could show, but for those of ELSEWHERE."""
    tracker = any(view.tracks for view in observation.views.values())
    moves = bool(np.any(np.abs(observation.rows.rate) > 0.05))
    found = []
    for name, effect in SOUGHT.items():
        if name in ELSEWHERE or (name in NEEDS_TRACKER and not tracker):
            continue
        if name in NEEDS_MOTION and not moves:
            continue
        special = _FORMS.get(name)
        if special is not None:
            found += list(special(observation))
        else:
            found.append(_plain(name, "", effect, np.arange(len(effect.vector()))))
    return found


def crosstalks() -> list[tuple[str, str, Crosstalk]]:
    """All pairs of axes: from, to, effect."""
    return [(a, b, Crosstalk(from_axis=a, to_axis=b)) for a, b in permutations(WRENCH_AXES, 2)]


def crosstalk_candidate(effect: Crosstalk) -> Candidate:
    """The form of one pair; coefficients between force and torque have a metre in them."""
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
    return Candidate(name, label, effect, free, start, start, typical, 0.05 * typical)


def _compliances(_: Observation) -> Iterator[Candidate]:
    for index, of in enumerate(_SOFTNESS):
        one = _plain("joint_compliance", of, JointCompliance(), np.array([index]))
        # Of exactly 0 the effect keeps the spring nominal, and a fit can't leave it.
        yield replace(one, probe=np.array([0.05]))
    both = _plain("joint_compliance", "all", JointCompliance(), np.arange(4))
    yield replace(both, probe=np.full(4, 0.05))


def _hysteresis(_: Observation) -> Iterator[Candidate]:
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
        yield replace(one, probe=probe, typical=typical)


def _backlashes(_: Observation) -> Iterator[Candidate]:
    for joint in ("roll", "tilt"):
        # With no gap the other numbers do nothing: they come in with the fit on the simulator.
        one = _plain("backlash", joint, Backlash(joint=joint, seat=2.0), np.arange(3))
        yield replace(one, probe=np.array([1e-3, 0.05, 0.1]))


def _cables(observation: Observation) -> Iterator[Candidate]:
    effect = CableDrag()
    joints = np.concatenate([v.scene.joints for v in observation.views.values()])
    rotation, origin = sensor_pose(joints[:: max(len(joints) // 2000, 1)])
    at = np.mean(origin + rotation @ np.asarray(effect.attachment_m), axis=0)
    for direction in product((-1.0, 0.0, 1.0), repeat=3):
        length = float(np.linalg.norm(direction))
        if length not in _CABLE_WAYS:
            continue
        anchor = at + _CABLE_REACH_M * np.array(direction) / length
        here = replace(
            effect,
            tension_n=0.0,
            anchor_m=tuple(float(x) for x in anchor),
            reference_m=tuple(float(x) for x in at),
        )
        free = np.arange(9)
        label = " ".join(f"{x:+.0f}" for x in direction)
        one = _plain("cable_drag", label, here, free)
        probe = np.array([0.05, *[0.02] * 3, *[0.005] * 3, 0.1, 1e-3])
        typical = np.array([0.3, *[0.4] * 3, *[0.06] * 3, 2.0, 0.01])
        yield replace(one, probe=probe, typical=typical)


_FORMS = {
    "joint_compliance": _compliances,
    "deflection_hysteresis": _hysteresis,
    "backlash": _backlashes,
    "cable_drag": _cables,
}
