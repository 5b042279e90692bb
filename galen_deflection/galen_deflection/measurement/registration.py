"""Where the tracker's markers stand to the arm: the 2019 report's eqs. (13) and (14), checked.

The report takes g_fB = g_Tf^-1 g_Tt g_Bt^-1 (f the base's marker, T the tracker, t the tool's
marker, B base_link) from one pose, and then reads the tool in the base as g_fB^-1 g_Tf^-1 g_Tt (its
eq. (14) prints p_Tt for g_Tt). Here, with W = g_fB^-1 the base's marker in base_link, Y the tool's
marker in tool_tip, M_i the tool's marker in the base's marker and F(q_i) the tip by the joints,

    W M_i Y^-1 = F(q_i)   at every position i without contact,

is solved by weighted least squares over all of them. With Y known (the identity, if nothing else is
said), one position tells W, and each further one checks it.

What a wrong arm does to it: a wrong tip and a wrong zero of the tilt are fixed in the tool, and so
exactly the same as a Y; with Y held they show as soon as the orientation differs between the
positions, and with Y estimated they vanish in it. A wrong zero of the roll turns all about an axis
that moves with the platform: W takes the turn up, and what is left is the turn times the
platform's way between positions. Wrong zeros of the platform's joints are W's translation, and do
not show at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from galen_model.arrays import Array
from galen_model.registration.rigid import Transform

from galen_deflection.errors import RegistrationError
from galen_deflection.measurement.registration_fit import (
    PositionCheck,
    RegistrationFit,
    RegistrationSettings,
)
from galen_deflection.measurement.rest_poses import RestPose


@dataclass(frozen=True)
class Registration:
    """The markers' places, and how well they are known.

    base_marker: in base_link (W); tool_marker: in tool_tip (Y). covariance (12, 12): of both,
    translation (m) and rotation vector (rad; turned from the left), zero for a Y that was given.
    sample_noise (6,): of one measured pose of the tip, in base_link. turns (3,): how far the
    positions' orientations spread, rad (`hand_eye.turns`).
    """

    base_marker: Transform
    tool_marker: Transform
    covariance: Array
    tool_marker_estimated: bool
    checks: tuple[PositionCheck, ...]
    sample_noise: Array
    turns: Array
    problems: tuple[str, ...]

    def tip(self, marker: Transform) -> Transform:
        """tool_tip in base_link, by the tool's marker in the base's (n): eq. (14)."""
        return self.base_marker @ marker @ self.tool_marker.inverse()


def register(
    rests: Sequence[RestPose], tip_m: Array, settings: RegistrationSettings | None = None
) -> Registration:
    """Register the tracker on rests of the arm; tip_m (3,) in ft_sensor.

    Raises RegistrationError where there is no rest, where the marker's own offset can't be told
    from them, and where a position doesn't agree with the others.
    """
    settings = settings or RegistrationSettings()
    if not rests:
        raise RegistrationError(
            "nowhere in the recording the arm stands untouched before its first push: leave it"
            " alone for a second or more at each position, and give the file of the tool that is on"
        )
    fit = RegistrationFit(rests, np.asarray(tip_m, dtype=float), settings)
    if settings.estimate_tool_marker:
        fit.require_turns()
    fit.solve()
    if settings.estimate_tool_marker:
        fit.require_offset_known()
    checks = fit.checks()
    failed = [check for check in checks if not check.holds]
    if failed:
        raise RegistrationError(_failure(failed, len(checks)) + _hint(rests, tip_m, settings))
    problems = [
        f"{check}: let pass, but no noise" for check in checks if check.distance > check.limit
    ]
    if not any(np.isfinite(check.distance) for check in checks):
        problems.append("registered at one position: nothing checks that it holds elsewhere")
    return Registration(
        fit.base,
        fit.tool_marker,
        fit.covariance(),
        settings.estimate_tool_marker,
        checks,
        fit.sample_noise(),
        fit.turns,
        tuple(problems),
    )


def _failure(failed: Sequence[PositionCheck], count: int) -> str:
    worst = max(failed, key=lambda check: check.distance)
    more = f"; so do {len(failed) - 1} more of {count}" if len(failed) > 1 else ""
    return f"the registration does not hold: {worst}{more}"


def _hint(rests: Sequence[RestPose], tip_m: Array, settings: RegistrationSettings) -> str:
    """Whether an offset of the tool's marker would explain it."""
    if settings.estimate_tool_marker:
        return ""
    try:
        other = register(
            rests,
            tip_m,
            replace(settings, estimate_tool_marker=True),
        )
    except RegistrationError:
        return ""
    off = other.tool_marker.displacement_from(settings.tool_marker)
    shift = ", ".join(f"{1e3 * value:.2f}" for value in off[:3])
    turn = ", ".join(f"{1e3 * value:.2f}" for value in off[3:])
    return (
        f"; it holds with the tool's marker off by ({shift}) mm and ({turn}) mrad: estimate it, or"
        " look for another tip or an offset of the tilt's zero, which look the same"
    )
