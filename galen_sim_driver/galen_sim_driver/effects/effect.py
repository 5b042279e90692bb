# SPDX-License-Identifier: Apache-2.0
"""Base of all simulated effects: parts of arm, sensor or tracker that the nominal model lacks.

An effect is a frozen dataclass whose fields are its parameters, named as the contract's section 6
names them, and whose hooks change what passes on the way from the reported joints to the
readings of sensor and tracker. All hooks take arrays of n samples in the order of time. The live
plant calls them with n = 1, `replay` with a whole bag; both so run the same code. A hook that isn't
overridden changes nothing.

The way, in this order (`replay.py`, `plant.py`):

1. `wrench_delay_s`, `tracker_delay_s`: a stamp is later than the measurement by that much.
2. `true_joints`: from the reported joints to the arm's own.
3. `arm`, `misaligned`, `gravity`: stiffness, geometry, gravity in base_link.
4. `tool_load`: mass and centre of the tool.
5. `wrench`: what else acts on the sensor, about its origin in ft_sensor.
6. `read`, in the order of `order`: from the true wrench to the reading; `unread` goes back.
7. `deflect`: what is added to the elastic deflection of the tip, in base_link.
8. `seen`, `base_marker`: the tracker's reading.

Effects that remember (play, friction) keep their state in the object that `fresh` returns.
base_link and ft_sensor stand for the arm's base and sensor frame, whatever they are called.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.sensor_motion import SensorMotion
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.load.model import Load


class ConfigError(GalenError):
    """A configuration value is invalid; the message names it."""


BAG_ORDER = ("sweep", "motion", "push")
"""A recording's bags as they were recorded, one after the other."""


class Fitted(NamedTuple):
    """A parameter that a diagnosis may estimate.

    `typical`: its usual size where the effect is there, in `unit`; one standard deviation of the
    prior, one number for all or one each. Values outside `lower` ... `upper` make no sense. `size`
    numbers, 1 for a scalar.
    """

    name: str
    unit: str
    typical: float | tuple[float, ...]
    lower: float
    upper: float
    size: int = 1

    @property
    def typicals(self) -> Array:
        """`typical` of each number, shape (size,)."""
        return np.broadcast_to(np.asarray(self.typical, dtype=float), (self.size,))


@dataclass(frozen=True)
class Instants:
    """Hold true times of n samples, the stamps' delay removed.

    bag_s (n,): since the bag's first stamp; session_s (n,): since the recording's first stamp.
    """

    bag: str
    bag_s: Array
    session_s: Array

    def __len__(self) -> int:
        return len(self.bag_s)


@dataclass(frozen=True)
class Posture:
    """Hold the true arm's state: n samples.

    joints (n, k) m and rad; rotation (n, 3, 3) R_base_sensor; origin (n, 3) of the sensor in
    base_link, m; gravity (n, 3) in ft_sensor, m/s^2. motion: of the sensor in ft_sensor, None
    without `needs_motion`. tool, adapter: the true loads. tip_m (3,) in ft_sensor. arm: the nominal
    one.
    """

    joints: Array
    rotation: Array
    origin: Array
    gravity: Array
    motion: SensorMotion | None
    tool: Load
    adapter: Load
    tip_m: Array
    arm: Arm


@dataclass(frozen=True)
class Loading:
    """Hold what bends the arm: n samples.

    joints (n, k) true; wrench (n, 6) at the tip in base_link, N and N.m; elastic (n, 6) the nominal
    springs' displacement of the tip in base_link, m and rad; arm: with its stiffness as it is.
    """

    joints: Array
    wrench: Array
    elastic: Array
    tip_m: Array
    arm: Arm


@dataclass(frozen=True)
class Effect:
    """Base of all effects: changes nothing.

    With its defaults an effect changes nothing either: every field is a `param` whose default is
    none of it, and whose meaning is that of the driver's parameter.

    order: where in `true_joints` and `read` it comes. after_noise: `read` gets the noise as well.
    needs_motion: `wrench` needs the posture's motion. contract_names: names of fields in the
    contract, where they are others; "a.b" is the entry b of a mapping a, left out where 0.
    beyond_contract: fields that the contract doesn't name. recording_only: fields that mean nothing
    to a driver.
    of_a_joint: it has a field `joint`, and at another joint it is another cause. has_limit: a
    specification limits it; else it is there or not.
    """

    name: ClassVar[str]
    fitted: ClassVar[tuple[Fitted, ...]] = ()
    order: ClassVar[int] = 0
    after_noise: ClassVar[bool] = False
    needs_motion: ClassVar[bool] = False
    contract_names: ClassVar[Mapping[str, str]] = {}
    beyond_contract: ClassVar[tuple[str, ...]] = ()
    recording_only: ClassVar[tuple[str, ...]] = ()
    of_a_joint: ClassVar[bool] = False
    has_limit: ClassVar[bool] = True

    @property
    def identity(self) -> str:
        """What a diagnosis distinguishes: `name`, or `name:joint` of an effect of a joint."""
        return f"{self.name}:{vars(self)['joint']}" if self.of_a_joint else self.name

    @property
    def limit_parts(self) -> tuple[str, ...]:
        """Return of each number of `vector` the name under which a specification may limit it.

        Of the first ones: the others have no limit.
        """
        part = vars(self)["joint"] if self.of_a_joint else ""
        return (part,) * len(self.vector())

    # --- on an arm ----------------------------------------------------------------------------

    def limit_names(self, arm: Arm) -> tuple[str, ...]:
        """Return all names on an arm under which a specification may limit it.

        Args:
            arm: the nominal one.

        Returns:
            Such as the arm's joints or the sensor's axes; an empty name: the effect as a whole.

        """
        return self.limit_parts

    @classmethod
    def kind_of(cls, arm: Arm) -> type[Effect]:
        """Return the effect as an arm has it, whose numbers may be other ones.

        Args:
            arm: the nominal one.

        Returns:
            This class, or one of the same name for that arm.

        """
        return cls

    @classmethod
    def none_of(cls, arm: Arm) -> Iterable[Effect]:
        """Return the effect at each place of an arm where it can be, changing nothing.

        Args:
            arm: the nominal one.

        Returns:
            One effect, or of an effect of a joint one a joint.

        """
        return [cls.kind_of(arm)()]

    # --- numbers ------------------------------------------------------------------------------

    @property
    def changes_nothing(self) -> bool:
        """Whether its numbers are those of an arm without it."""
        return bool(np.array_equal(self.vector(), type(self)().vector()))

    def validate(self) -> None:
        """Raise ConfigError, naming the field, where the numbers don't fit together."""

    def vector(self) -> Array:
        """Return the fitted parameters as one array, in the order of `fitted`."""
        return np.concatenate(
            [np.atleast_1d(np.asarray(getattr(self, p.name), dtype=float)) for p in self.fitted]
        )

    def with_vector(self, vector: Array) -> Self:
        """Return the same effect with other numbers.

        Args:
            vector: as `vector` gives it, in the units of `fitted`.

        Returns:
            A new effect, unchecked.

        """
        values, at = {}, 0
        for p in self.fitted:
            part = vector[at : at + p.size]
            values[p.name] = float(part[0]) if p.size == 1 else tuple(float(v) for v in part)
            at += p.size
        return replace(self, **values)

    def in_session(self, starts: Mapping[str, float]) -> Self:
        """Return the effect with its time since the session's start.

        Args:
            starts: first stamp of each bag, by its name, s since the session's.

        Returns:
            The same effect where it has no time of its own.

        """
        return self

    def fresh(self) -> Effect:
        """Return the effect at the start of a bag; effects with memory return a new object."""
        return self

    # --- the way from joints to readings ------------------------------------------------------

    @property
    def wrench_delay_s(self) -> float:
        """How much later than the measurement a wrench's stamp is."""
        return 0.0

    @property
    def tracker_delay_s(self) -> float:
        """How much later than the measurement a tracker's stamp is."""
        return 0.0

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """Return the true joints of reported ones.

        Args:
            when: times of the n samples.
            joints: reported (n, k), m and rad; not to be changed.

        Returns:
            True joints (n, k), m and rad.

        """
        return joints

    def arm(self, arm: Arm) -> Arm:
        """Return the arm with its true stiffness.

        Args:
            arm: the nominal one, with the effects before this one.

        Returns:
            The same arm where nothing changes.

        """
        return arm

    def misaligned(self, arm: Arm) -> Arm:
        """Return the arm with its true geometry, which poses follow and springs don't.

        Args:
            arm: the one with its true stiffness, and the effects before this one.

        Returns:
            The same arm where nothing changes.

        """
        return arm

    def gravity(self, gravity_base: Array) -> Array:
        """Return true gravity in base_link.

        Args:
            gravity_base: nominal (3,), m/s^2, in base_link.

        Returns:
            True (3,), m/s^2.

        """
        return gravity_base

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """Return the tool's true mass and centre.

        Args:
            mass_kg: as the tool's file has it, kg.
            com_m: centre (n, 3) in ft_sensor, m.
            direction: of gravity (n, 3) in ft_sensor, unit vectors; zeros where it is not known.

        Returns:
            Mass, kg, and centre (n, 3) in ft_sensor, m.

        """
        return mass_kg, com_m

    def wrench(self, when: Instants, posture: Posture) -> Array | None:
        """Return what else acts on the sensor.

        Args:
            when: times of the n samples.
            posture: the true arm and its loads.

        Returns:
            Wrench (n, 6) about the sensor's origin in ft_sensor, N and N.m; None for nothing.

        """
        return None

    def read(self, when: Instants, wrench: Array) -> Array:
        """Return the reading of a wrench.

        Args:
            when: times of the n samples.
            wrench: (n, 6) in ft_sensor, N and N.m, the zero subtracted; with the effects before
                this one.

        Returns:
            Reading (n, 6), N and N.m.

        """
        return wrench

    def unread(self, when: Instants, reading: Array) -> Array:
        """Return the wrench of a reading: the inverse of `read`.

        Args:
            when: times of the n samples.
            reading: (n, 6), N and N.m.

        Returns:
            Wrench (n, 6) in ft_sensor, N and N.m; what `read` has lost is not found again.

        """
        return reading

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        """Return the tip's displacement beside the elastic one.

        Args:
            when: times of the n samples.
            loading: joints, and the wrench that bends the arm.

        Returns:
            Translation and rotation vector (n, 6) in base_link, m and rad; None for nothing.

        """
        return None

    def seen(self, when: Instants, position: Array) -> Array:
        """Return the tracker's reading of a marker's position.

        Args:
            when: times of the n samples.
            position: true (n, 3) in the tracker's frame, m.

        Returns:
            Reading (n, 3) in the tracker's frame, m.

        """
        return position

    def base_marker(self, when: Instants) -> Array | None:
        """Return the base marker's displacement.

        Args:
            when: times of the n samples.

        Returns:
            Translation and rotation vector (n, 6) in base_link, m and rad; None for nothing.

        """
        return None


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Sort effects as they come one after the other, by `order`.

    Args:
        effects: any effects.

    Returns:
        The same ones; equals as they are given.

    """
    return tuple(sorted(effects, key=lambda effect: effect.order))


def added(parts: Iterable[Array | None]) -> Array | None:
    """Add the parts that there are.

    Args:
        parts: arrays of one shape, or None for nothing.

    Returns:
        Their sum; None where there is none.

    """
    given = [part for part in parts if part is not None]
    return sum(given[1:], given[0]) if given else None


def check_choice(effect: str, name: str, value: str, choices: Iterable[str]) -> None:
    """Check that a value is one of the choices.

    Args:
        effect: name of the effect, for the message.
        name: that of its parameter.
        value: what was asked for.
        choices: all that can be.

    Raises:
        ConfigError: it is none of them.

    """
    if value not in choices:
        raise ConfigError(f"{effect}: {name} is {value!r}, not one of {', '.join(choices)}")
