# SPDX-License-Identifier: Apache-2.0
"""Whether the mounting's parameters pay: a matter of poses held out by blocks, not of the residual.

Blocks of neighbouring poses, in visiting order, are left out of both sweeps in turn; three models
fitted to the rest predict the readings with the tool: the ten-parameter least squares of other
packages (from the sweep with the tool alone), loads without a mounting, loads with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.estimation.held_out import BlockGain, block_gain
from galen_model.load.identification import (
    Identification,
    KnownLoad,
    identify_one_sweep,
    identify_two_sweeps,
    plain_least_squares,
)
from galen_model.load.model import gravity_regressor, gravity_wrench
from galen_model.load.mounting import Mounting
from galen_model.load.readings import StillPoses

BLOCKS = 5
_Predict = Callable[[StillPoses], Array]
PLAIN, ROBUST, MOUNTED = "plain least squares", "galen", "galen, mounted"
"""The models' names."""


@dataclass(frozen=True)
class Worth:
    """Held-out residuals of the readings with the tool.

    rmse: (6,) by model, N and N.m, NaN where the model rejected some block; gain: by how much the
    mounting lowers the mean squared residual in units of the noise, and its standard deviation
    over the blocks; by_kind: the same of forces and of torques; against: the model compared with.
    """

    rmse: dict[str, Array]
    gain: float
    gain_std: float
    by_kind: tuple[BlockGain, BlockGain]
    against: str
    blocks: int

    @property
    def worse(self) -> str:
        """Which of "forces" and "torques" becomes worse beyond chance; else empty.

        A rotation, an inclination or a zero acts on both; one at the cost of the other is
        something else.
        """
        force, torque = self.by_kind
        return "forces" if force.clear_loss else "torques" if torque.clear_loss else ""

    @property
    def pays(self) -> bool:
        """Whether the gain is beyond chance, and not one kind's at the other's cost."""
        return BlockGain(self.gain, self.gain_std).clear and not self.worse

    @property
    def sentence(self) -> str:
        """The verdict for a person."""
        change = (
            f"on {self.blocks} held-out blocks they lower the squared residual by "
            f"{self.gain:.3g} +- {self.gain_std:.2g} of the noise's, against {self.against}"
        )
        if self.worse and self.gain > 0.0:
            change += f"; but the {self.worse} become worse, so that it is something else"
        if self.pays:
            return f"the mounting's parameters pay: {change}"
        return f"the mounting's parameters do not pay, calibrate without them: {change}"


def compare(parts: Mapping[str, Sequence[Array]], sigma: Array) -> Worth:
    """Compare the models by their held-out residuals.

    Args:
        parts: residuals (k, 6) by model (`PLAIN`, `ROBUST` and `MOUNTED`) and block, N and N.m, NaN
            where the model rejected a block; two blocks at least, empty ones don't count.
        sigma: (6,) noise of a reading, N and N.m.

    Returns:
        The scores.

    """
    squares = {  # (blocks, 2): forces, torques
        name: np.array(
            [
                np.mean((part / sigma) ** 2, axis=0).reshape(2, 3).mean(axis=1)
                for part in of
                if len(part)
            ]
        )
        for name, of in parts.items()
    }
    against = ROBUST if np.all(np.isfinite(squares[ROBUST])) else PLAIN
    gains = squares[against] - squares[MOUNTED]
    return Worth(
        {name: np.sqrt(np.mean(np.concatenate(of) ** 2, axis=0)) for name, of in parts.items()},
        *block_gain(gains.mean(axis=1)),
        (block_gain(gains[:, 0]), block_gain(gains[:, 1])),
        against,
        len(gains),
    )


@dataclass(frozen=True)
class Calibrated:
    """What was measured: sweeps, the zeroing pose (rad), what is known, the groups asked for."""

    bare: StillPoses | None
    tool: StillPoses
    groups: Sequence[str]
    zero_angles: ArrayLike | None = None
    known: KnownLoad | None = None

    def identify(self) -> Identification:
        """Identify the loads from all poses, or those that `without` leaves.

        Returns:
            What a fit without a choice of models finds.

        Raises:
            IdentificationError: the poses don't identify what is asked, or a known load comes with
                one sweep alone.

        """
        if self.bare is not None:
            return identify_two_sweeps(
                self.bare, self.tool, self.zero_angles, self.groups, self.known
            )
        if self.known is not None:
            raise IdentificationError("a known mass of the tool needs two sweeps")
        return identify_one_sweep(self.tool, self.zero_angles, self.groups)

    @property
    def unmounted(self) -> Calibrated:
        """The same without a mounting."""
        return replace(self, groups=(), known=None)

    def without(self, block: int, blocks: int) -> Calibrated:
        """Leave out a block of each sweep.

        Args:
            block: its number, from 0 on.
            blocks: into how many each sweep is cut, in visiting order.

        Returns:
            The same with the poses that remain.

        """
        bare = None if self.bare is None else self.bare.take(~_held(self.bare, block, blocks))
        tool = self.tool.take(~_held(self.tool, block, blocks))
        return replace(self, bare=bare, tool=tool)


def worth(measured: Calibrated, all_poses: Identification, blocks: int = BLOCKS) -> Worth:
    """Score the models on held-out blocks.

    Args:
        measured: the calibration, with the mounting's groups.
        all_poses: the mounted fit to everything, whose outliers don't count.
        blocks: into how many each sweep is cut.

    Returns:
        The scores.

    Raises:
        IdentificationError: the mounting can't be fitted without a block.

    """
    parts: dict[str, list[Array]] = {name: [] for name in (PLAIN, ROBUST, MOUNTED)}
    for block in range(blocks):
        held = _held(measured.tool, block, blocks)
        rest = measured.without(block, blocks)
        scored = measured.tool.take(held & all_poses.used_tool)
        try:
            mounted = rest.identify()
        except IdentificationError as error:
            raise IdentificationError(
                f"without block {block + 1} of {blocks} of the poses: {error}"
            ) from error
        for name, predict in zip(parts, _models(rest, mounted), strict=True):
            left = np.full((len(scored), 6), np.nan) if predict is None else predict(scored)
            parts[name].append(scored.wrench - left)
    return compare(parts, all_poses.sigma)


def _models(rest: Calibrated, mounted: Identification) -> list[_Predict | None]:
    moments, offset = plain_least_squares(rest.tool.gravity, rest.tool.wrench)
    try:
        unmounted = rest.unmounted.identify()
    except IdentificationError:  # far off, readings fit no load at all without a mounting
        galen = None
    else:
        galen = _predictor(unmounted, rest.zero_angles)
    return [
        lambda poses: gravity_regressor(poses.gravity) @ moments + offset,
        galen,
        _predictor(mounted, rest.zero_angles),
    ]


def _predictor(found: Identification, zero_angles: ArrayLike | None) -> _Predict:

    def predict(poses: StillPoses) -> Array:
        mounting = found.mounting or Mounting.of(poses.arm)
        gravity = mounting.gravity_in_sensor(poses.angles, poses.arm)
        wrench = (
            gravity_wrench(gravity, found.load.load)
            + gravity_wrench(gravity, found.adapter.load)
            - gravity_wrench(mounting.gravity_in_sensor(zero_angles, poses.arm), found.adapter.load)
        )
        return np.asarray(wrench @ mounting.reading_from_wrench.T + found.offset)

    return predict


def _held(poses: StillPoses, block: int, blocks: int) -> np.ndarray:
    return np.asarray(np.arange(len(poses)) * blocks // len(poses) == block)
