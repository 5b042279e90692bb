# SPDX-License-Identifier: Apache-2.0
"""Does the load fit, and if not, why: verdicts, and what decides them.

- `verdict`: causes, their messages, and the limits of what matters, for every question below.
- `held_out`, `search`: tables of the diagnosis, scored on held-out blocks.

By what each decides, out of `galen_model.estimation`:

- calibration monitor (`galen_gravcomp.calibration_monitor`): the rest segments of a live stream;
  the evidence of five hypotheses, any segment may be a contact.
- calibration check (`galen_calibration_behavior.quick_check`): six poses; the chance of a load, an
  offset, and of what neither explains.
- `evaluate` (`galen_gravcomp.evaluate`): the rest segments of a recording; the same chances, and
  of a drift, after a robust fit.
- diagnosis (`galen_diagnosis.inference`): white rows of three bags; evidence, refined in the
  simulator.
"""
