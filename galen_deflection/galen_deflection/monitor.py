# SPDX-License-Identifier: Apache-2.0
"""Health of the deflection's node: state, rates, counts. No ROS."""

from __future__ import annotations

from collections import deque

import numpy as np
from galen_common.stream.monitor import RATE_WINDOW_S, Severity, StreamMonitor, StreamState, joined
from galen_common.stream.samples import Rejection
from galen_model.arrays import Array

from galen_deflection.deflector import Deflector, ModelRejection

# Of the compensator's reasons those that the deflector never has.
_NOT_HERE = (Rejection.DISABLED, Rejection.NO_TOOL)


class DeflectorMonitor(StreamMonitor):
    """Watches one deflector; times as `StreamMonitor` says."""

    reasons = tuple(r for r in Rejection if r not in _NOT_HERE) + tuple(ModelRejection)
    not_shown = (Rejection.RESTART, ModelRejection.NO_MODEL, ModelRejection.OTHER_TIP)
    working = "predicting"

    def __init__(self, deflector: Deflector) -> None:
        super().__init__(deflector.pairing)
        self._deflector = deflector
        self._model_error = ""
        self._last_forgotten = ""
        self._shares: deque[tuple[float, int, int]] = deque()

    def set_model_error(self, text: str) -> None:
        """Set why the model asked for at start is not loaded.

        Args:
            text: the reason; empty when a model is active.

        """
        self._model_error = text

    def on_forgotten(self, why: str, now_s: float) -> None:
        """Note that loads were forgotten.

        Args:
            why: the reason, in words.
            now_s: wall time, s, monotonic.

        """
        self._last_forgotten = why
        self.on_notice(f"the loads so far are forgotten: {why}", now_s)

    def tick(self, now_s: float) -> None:
        """As `StreamMonitor.tick`.

        Args:
            now_s: wall time, s, monotonic.

        """
        super().tick(now_s)
        deflector, shares = self._deflector, self._shares
        shares.append((now_s, deflector.predicted, deflector.extrapolated))
        while len(shares) > 2 and now_s - shares[1][0] > RATE_WINDOW_S:
            shares.popleft()

    @property
    def extrapolated_share(self) -> float:
        """Of the deflections of the last two seconds, 0 to 1."""
        if len(self._shares) < 2:
            return 0.0
        (_, first, first_outside), (_, last, last_outside) = self._shares[0], self._shares[-1]
        return (last_outside - first_outside) / (last - first) if last > first else 0.0

    def _standing_state(self) -> StreamState | None:
        if self._model_error:
            text = f"nothing is published: {self._model_error}; set model_file to a good file"
            return StreamState(Severity.ERROR, "bad_model_file", text)
        if self._deflector.model is None:
            text = "no model is loaded: set model_file; nothing is published"
            return StreamState(Severity.WARN, ModelRejection.NO_MODEL.value, text)
        if self._deflector.other_tip:
            text = f"nothing is published: {self._deflector.other_tip}"
            return StreamState(Severity.ERROR, ModelRejection.OTHER_TIP.value, text)
        return None

    def _running_state(self) -> StreamState:
        model = self._deflector.model
        assert model is not None
        text = f"predicting by {model.name}"
        share = self.extrapolated_share
        if share > 0.0:
            text += f", {100.0 * share:.0f} % of it beyond what the model was fitted on"
            return StreamState(Severity.WARN, "extrapolating", text)
        last = self._deflector.last
        if last is not None and last.predicted.start is not None:
            start = last.predicted.start
            if np.trace(start[:3, :3]) > 0.5 * np.trace(last.predicted.covariance[:3, :3]):
                text += (
                    "; loads before the start are not known, so that it is uncertain by"
                    f" {1e3 * _size(start[:3, :3]):.2g} mm until the arm has been pushed both ways"
                )
                return StreamState(Severity.OK, "start_unknown", text)
        return StreamState(Severity.OK, self.working, text)

    def values(self, now_s: float) -> dict[str, object]:
        """Everything measured, for /diagnostics; units are in the names.

        Args:
            now_s: wall time, s, monotonic.

        Returns:
            Values by key.

        """
        deflector = self._deflector
        model, last = deflector.model, deflector.last
        values: dict[str, object] = {"model": "" if model is None else model.name}
        if model is not None:
            values["model_tip_m"] = joined(np.asarray(model.tip_m))
        values["sensor_frame"] = deflector.pairing.sensor_frame
        if last is not None:
            covariance = last.predicted.covariance
            values |= {
                "deflection_mm": joined(1e3 * last.predicted.mean[:3]),
                "deflection_mrad": joined(1e3 * last.predicted.mean[3:]),
                "std_mm": 1e3 * _size(covariance[:3, :3]),
                "std_mrad": 1e3 * _size(covariance[3:, 3:]),
            }
            start = last.predicted.start
            if start is not None:
                values["std_of_unknown_start_mm"] = 1e3 * _size(start[:3, :3])
                values["std_of_unknown_start_mrad"] = 1e3 * _size(start[3:, 3:])
        values |= self.inputs(now_s, "deflection")
        values |= {
            "received": deflector.pairing.received,
            "predicted": deflector.predicted,
            "extrapolated": deflector.extrapolated,
            "extrapolated_percent": 100.0 * self.extrapolated_share,
            "forgotten": deflector.forgotten,
            "last_forgotten": self._last_forgotten,
        }
        return values | self.rejected()


def _size(covariance: Array) -> float:
    """Return the standard deviation of the length of a vector of this covariance (3, 3)."""
    return float(np.sqrt(np.trace(covariance)))
