# SPDX-License-Identifier: Apache-2.0
"""Judge whether a load fits to still readings, and which wrong set-up explains them if not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.setup_check.mistakes import KINDS, Corrected
from galen_model.setup_check.readings import LoadFit, StillReadings, fit_load

FEWEST_POSES = 4
"""With fewer there is no residual."""

_NOISES = 3.0  # a residual of so many standard deviations of an averaged reading is none of noise
_FITS = 0.02  # nor one above this share of how the readings change
_EXPLAINED = 0.1  # what an explanation leaves at most, of how the readings change
_PAIR_EXPLAINED = 0.3  # two mistakes are looked for where no load explains so much
_GAIN = 10.0  # and how many times smaller it makes the residuals, forces' times torques'
_FITTED_GAIN = 30.0  # where numbers were fitted: a cable's pull is inclined, too, to a part
_FITTED_KIND_GAIN = 3.0  # and then of forces and torques each that is not noise
_ALIKE = 1.25  # residuals in this ratio are as good
_TURNED_M_S2 = 2.0  # gravity changes by so much, root mean square, before anything is judged
_LIGHT_N = 0.1  # and forces by so much
_UNEXPLAINED_N = 1.0  # a residual that nothing on the list explains is reported from here on
_MOST_NAMED = 4
_DEAD = 0.02


class SetupError(GalenError):
    """The set-up is wrong, or no load explains the readings; the text holds the explanations."""


@dataclass(frozen=True)
class SetupExplanation:
    """One or two mistakes that explain the readings; `fit` is the load without them."""

    mistakes: tuple[Corrected, ...]
    fit: LoadFit

    @property
    def what(self) -> str:
        """What is wrong, a clause."""
        return ", and ".join(mistake.what for mistake in self.mistakes)

    @property
    def parameters(self) -> int:
        """How many numbers were fitted to undo them."""
        return sum(mistake.parameters for mistake in self.mistakes)

    @property
    def remedy(self) -> str:
        """What corrects it."""
        return "; ".join(mistake.remedy for mistake in self.mistakes)

    @property
    def test(self) -> str:
        """How a person sees whether it is this."""
        return "; ".join(dict.fromkeys(mistake.test for mistake in self.mistakes))


@dataclass(frozen=True)
class SetupFinding:
    """A set-up that is wrong.

    Attributes:
        fit: the load that fits to the readings as they are.
        explanations: which mistakes explain them, all about as well; those named first are more
            common. Empty where none on the list does.
        dead: axes of force that hardly change, where others do.

    """

    fit: LoadFit
    explanations: tuple[SetupExplanation, ...]
    dead: tuple[str, ...] = ()

    @property
    def gross(self) -> bool:
        """Whether it is more than an effect that a diagnosis names, and what explains it is known.

        A base that is inclined by a few degrees is such an effect.
        """
        off = bool(self.fit.fault) or bool(np.max(self.fit.relative) > _EXPLAINED)
        return off and bool(self.explanations)

    @property
    def trouble(self) -> str:
        """What doesn't fit as it is."""
        if self.fit.fault and self.fit.relative[0] < _EXPLAINED:
            return self.fit.fault
        return f"no load fits: the residual is {_sizes(self.fit)}"

    @property
    def sentence(self) -> str:
        """Everything for a person, in one paragraph."""
        parts = [self.trouble]
        if not self.explanations:
            parts.append("none of the common mistakes of a set-up explains it")
        if not self.explanations and self.dead:
            parts.append(
                f"forces {', '.join(self.dead)} hardly change: does the sensor measure them?"
            )
        named = self.explanations[:_MOST_NAMED]
        for index, one in enumerate(named):
            instead = "" if self.trouble == self.fit.fault else f", instead of {_sizes(self.fit)}"
            parts.append(
                f"{'or' if index else 'explained by the set-up'}: {one.what}"
                f" (residual {_sizes(one.fit)}{instead}; {one.fit.mass_kg * 1e3:.0f} g);"
                f" remedy: {one.remedy}"
            )
        if len(named) > 1:
            tests = dict.fromkeys(one.test for one in named)
            parts.append(f"these do alike; what separates them: {'; '.join(tests)}")
        return ". ".join(part[0].upper() + part[1:] for part in parts)

    def to_json(self) -> dict[str, Any]:
        """Describe the finding for a program.

        Returns:
            Texts and numbers, SI units.

        """
        return {
            "trouble": self.trouble,
            "residual": _by_kind(self.fit),
            "explanations": [
                {
                    "what": one.what,
                    "remedy": one.remedy,
                    "test": one.test,
                    "residual": _by_kind(one.fit),
                    "mass_kg": one.fit.mass_kg,
                    "com_m": one.fit.com_m.tolist(),
                }
                for one in self.explanations
            ],
        }


def _sizes(fit: LoadFit) -> str:
    return f"{fit.residual[0]:.3g} N, {fit.residual[1]:.3g} N.m"


def _by_kind(fit: LoadFit) -> dict[str, float]:
    return {"force_n": float(fit.residual[0]), "torque_nm": float(fit.residual[1])}


def check_setup(readings: StillReadings, noise: Array | None = None) -> SetupFinding | None:
    """Find which wrong set-up explains still readings, where no load does or one that can't be.

    Each mistake of `mistakes.KINDS` is undone by itself, then two of different kinds together, and
    one load with a constant bias fitted to what results. A mistake explains the readings where its
    load is one that a wrist carries, what it leaves is at most a tenth of how the readings change,
    and, unless the load without it is impossible, the residuals of forces and torques together are
    ten times smaller. It costs one fit where a load fits.

    Args:
        readings: n still poses with one load.
        noise: (6,) standard deviation of an averaged reading, N and N.m; None: not known.

    Returns:
        None where a load fits, or where too little turned or weighed to tell.

    """
    turned = readings.gravity - readings.gravity.mean(axis=0)
    if len(readings.wrench) < FEWEST_POSES or np.sqrt(np.mean(turned**2) * 3.0) < _TURNED_M_S2:
        return None
    fit = fit_load(readings)
    if fit.change[0] * np.sqrt(3.0) < _LIGHT_N:
        return None
    if not fit.fault and np.all(_fits(fit, noise)):
        return None
    # What is off by little is no exchanged axis, and two mistakes at once explain too much.
    off = 1.0 if fit.fault else float(np.max(fit.relative))
    good = [
        one
        for one in _singles(readings)
        if (off > _EXPLAINED or one.parameters) and _explains(one, fit, noise)
    ]
    if not good and off > _PAIR_EXPLAINED:
        good = [one for one in _pairs(readings) if _explains(one, fit, noise)]
    if good:
        return SetupFinding(fit, _best(good))
    gross = fit.fault or (fit.relative[0] > 0.5 and fit.residual[0] > _UNEXPLAINED_N)
    return SetupFinding(fit, (), _dead_axes(readings)) if gross else None


def _dead_axes(readings: StillReadings) -> tuple[str, ...]:
    """Name axes of force that hardly change although gravity along them does."""
    force, gravity = np.std(readings.wrench[:, :3], axis=0), np.std(readings.gravity, axis=0)
    dead = (force < _DEAD * force.max()) & (gravity > 0.2 * gravity.max())
    return tuple(name for name, out in zip(WRENCH_AXES[:3], dead, strict=True) if out)


def check_fit(readings: StillReadings, mistake: Corrected) -> SetupFinding | None:
    """Check whether one mistake explains readings that no load fits.

    Args:
        readings: n still poses with one load.
        mistake: the same readings without it.

    Returns:
        The finding; None where it does not explain them.

    """
    fit = fit_load(readings)
    one = SetupExplanation((mistake,), fit_load(mistake.readings, mistake.parameters))
    return SetupFinding(fit, (one,)) if _explains(one, fit, None) else None


def require_setup(readings: StillReadings, noise: Array | None = None) -> None:
    """Check as `check_setup` does.

    Args:
        readings: n still poses with one load.
        noise: (6,) standard deviation of an averaged reading, N and N.m; None: not known.

    Raises:
        SetupError: the set-up is wrong, or no load explains the readings.

    """
    found = check_setup(readings, noise)
    if found is not None:
        raise SetupError(found.sentence)


def _fits(fit: LoadFit, noise: Array | None) -> np.ndarray:
    """Whether the residuals of forces and torques (2,) are noise, or small."""
    small = fit.relative < _FITS
    if noise is None:
        return np.asarray(small)
    kinds = np.sqrt(np.mean(noise.reshape(2, 3) ** 2, axis=1))
    return np.asarray(small | (fit.residual < _NOISES * kinds))


def _explains(one: SetupExplanation, before: LoadFit, noise: Array | None) -> bool:
    found = one.fit
    if found.fault:
        return False
    # Of a torque that is noise nothing has to be explained.
    fits = _fits(found, noise)
    if not (fits[0] or found.relative[0] < _EXPLAINED):
        return False
    scale = before.change / np.maximum(found.change, 1e-12)  # kgf, N.mm: the units differ
    ratio = before.residual / np.maximum(found.residual * scale, 1e-12)
    if np.any(ratio < 1.0 / _ALIKE):
        return False
    if before.fault:
        return True
    if not one.parameters:
        return bool(np.prod(ratio) > _GAIN)
    return bool(np.prod(ratio) > _FITTED_GAIN and np.all(fits | (ratio > _FITTED_KIND_GAIN)))


def _best(good: list[SetupExplanation]) -> tuple[SetupExplanation, ...]:
    """Return those whose residuals are about the smallest; the list's order is kept."""
    badness = [float(np.sum(np.log(np.maximum(one.fit.relative, 1e-9)))) for one in good]
    least = min(badness) + 2.0 * np.log(_ALIKE)
    return tuple(one for one, bad in zip(good, badness, strict=True) if bad <= least)


def _singles(readings: StillReadings) -> Iterator[SetupExplanation]:
    for kind in KINDS:
        for one in kind(readings):
            yield SetupExplanation((one,), fit_load(one.readings, one.parameters))


def _pairs(readings: StillReadings) -> Iterator[SetupExplanation]:
    """Yield two mistakes of different kinds, the one undone after the other.

    Units and orientation first: axes and gravity are found from what they leave.
    """
    first_kinds = (*KINDS[2:], KINDS[1])
    for at, kind in enumerate(first_kinds):
        for one in kind(readings):
            for second in (*first_kinds[at + 1 :], KINDS[0]):
                for two in second(one.readings):
                    fit = fit_load(two.readings, one.parameters + two.parameters)
                    yield SetupExplanation((one, two), fit)
