"""Does the load fit, and if not, why? One engine for every observation.

Each capability brings readings to it, and each question has the same parts:

1. Rows y in blocks (rest segments, stretches of time), whitened by their noise S.
2. Hypotheses: columns X with weights w ~ N(0, P^-1). Which column is a cause and which one a
   nuisance (the sensor's zero, what the calibration does not know) is a matter of P.
3. The evidence of a hypothesis: the density of y with w integrated out (`linear`).
4. The weights' posterior, and the chance that noise alone makes as much (`linear`).
5. The score on held-out blocks: how well the others predict each block (`held_out`).

The observations, and by what each decides:

- calibration monitor (`galen_gravcomp.calibration_monitor`): the rest segments of a live stream;
  the evidence of five hypotheses, any segment may be a contact.
- calibration check (`galen_calibration_behavior.quick_check`): six poses; the chance of a load, an
  offset, and of what neither explains.
- `evaluate` (`galen_gravcomp.evaluate`): the rest segments of a recording; the same chances, and
  of a drift, after a robust fit.
- tables (`galen_diagnosis.tables`): stops or runs; the score on held-out blocks.
- diagnosis (`galen_diagnosis.inference`): white rows of three bags; evidence, refined in the
  simulator.

How a cause shows is in `columns`; causes, messages and the limits of what matters in `verdict`;
what is fitted beside every hypothesis in `linear`.
"""
