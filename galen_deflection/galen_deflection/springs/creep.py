"""Creep: what a spring still gives by after its load has come, slowly.

A Kelvin-Voigt element, a spring and a damper side by side, follows its load l with a time constant,

    tau dy/dt = l - y,

and some of them in series with a spring are the usual model of linear creep (W. N. Findley, J. S.
Lai, K. Onaran, *Creep and Relaxation of Nonlinear Viscoelastic Materials*, chapter 5, 1976): the
displacement is c l + sum_i c_i y_i, c_i >= 0, linear in what is to be found. For a load that goes
straight from l_0 to l_1 in the time h, with e = exp(-h / tau),

    y_1 = e y_0 + (1 - e) l_0 + (l_1 - l_0) (1 - (1 - e) tau / h),

without error. After a jump in time the load in between is unknown, and straight is a guess.

Where it starts: y = 0, never loaded before. Unloaded, that is where every past ends. Under load the
past may have been anything between a load that has just come (y = 0) and one that has long been
(y = l); this spread decays as e does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

_UNIFORM_STD = 1.0 / np.sqrt(12.0)


class Crept(NamedTuple):
    """Outputs (n, m) from y = 0, and what is unknown of them.

    unknown (n, m): root mean square distance from them, were all starts between 0 and the first
    load as likely.
    """

    output: Array
    unknown: Array


class LagOperators:
    """m Kelvin-Voigt elements, each with its own time constant and input; they remember."""

    def __init__(self, time_constants_s: Array) -> None:
        """time_constants_s (m,): positive. Starts as `reset` does."""
        self._tau_s = np.asarray(time_constants_s, dtype=float)
        if np.any(self._tau_s <= 0.0):
            raise ValueError(f"a time constant is not positive: {self._tau_s.min()} s")
        self.reset()

    def reset(self) -> None:
        """Forget all loads."""
        self._before: tuple[int, Array, Array, Array] | None = None

    def run(self, stamp_ns: np.ndarray, inputs: Array) -> Crept:
        """Take inputs (n, m) at stamps (n,) in their order, from where the last call left off.

        A stamp that is not after the last one moves nothing.
        """
        output, unknown = np.empty(inputs.shape), np.empty(inputs.shape)
        for row, (now_ns, load) in enumerate(zip(stamp_ns.tolist(), inputs, strict=True)):
            if self._before is None:
                y = np.zeros(len(self._tau_s))
                # Uniform on [0, l]: its mean square distance from the end 0 is l^2 / 3.
                left = np.abs(load) * 2.0 * _UNIFORM_STD
            else:
                before_ns, last, y, left = self._before
                if now_ns > before_ns:
                    steps = (now_ns - before_ns) * 1e-9 / self._tau_s
                    gone = -np.expm1(-steps)
                    y = y + gone * (last - y) + (load - last) * (1.0 - gone / steps)
                    left = (1.0 - gone) * left
                else:
                    now_ns = before_ns
            self._before = now_ns, load.copy(), y, left
            output[row], unknown[row] = y, left
        return Crept(output, unknown)
