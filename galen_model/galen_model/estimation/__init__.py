# SPDX-License-Identifier: Apache-2.0
"""Estimation: one linear problem, its solution, its outliers, and its score on held-out blocks.

- `problem`: readings of channels that are linear in parameters, with what is known beforehand and
  biases that are curves in time; least squares with the channels' own noise, rejection of whole
  readings, Gauss-Newton.
- `least_squares`: rows of known noise, nothing else.
- `curves`: the biases that a problem may have.
- `held_out`: which of two problems predicts blocks better that neither has seen.
- `evidence`: what columns beside a background are worth, and how much of a gap they close.
"""
