"""Probabilities of hypotheses: none, effects alone and together, and something that isn't listed.

The few numbers of the evidence that are not physics are calibrated on simulated recordings:
`python -m benchmarks.calibrate_diagnosis` makes `calibration.json`; causes, sessions and unknown
kinds there are others than those of `blind_check`.

An effect's model is not quite the arm's: of the energy E that an effect explains, its model leaves
a part kappa^2 E, spread over nu directions that the other hypotheses don't have. Under a hypothesis
whose fit leaves the energy E_h the log likelihood is that of nu such directions with variance
1 + v, v = kappa^2 (energy explained) / nu, beside white noise,

    l_h = -1/2 (E_h / (1 + v_h) + nu log(1 + v_h)) - Occam_h,

with Occam_h = 1/2 log det(1 + L G) of the fit. "Unknown" is something unlisted beside one of these,
or alone: nu_u directions with the variance that fits best, which take what the best fit leaves, L,

    l_u = max_h l_h(E_h - L) - 1/2 (nu_u + nu_u log(L / nu_u)),

and all of E_0 where nothing listed is there. "None" has nothing but noise and a healthy arm's
excess. Probabilities go as exp(eta l - c), with c what effects and unknown ones cost
beforehand: eta < 1 tempers evidence that is never as good as its formula (Grünwald, van Ommen,
Bayesian Analysis 12, 2017). Energies are counted from the noise, with the structure that the best
fit leaves (`structure.py`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources

import numpy as np
from scipy.special import logsumexp

from galen_diagnosis.inference.refine import Hypothesis
from galen_diagnosis.inference.search import Found

KNOWN = {
    "sensor_drift": "loose",
    "cable_drag": "loose",
    "deflection_hysteresis": "loose",
    "backlash": "loose",
    "inertial_load": "loose",
    "sensor_saturation": "loose",
    "loose_tool": "loose",
    "base_shift": "firm",
    "bias_step": "firm",
    "joint_compliance": "firm",
    "wrench_delay": "firm",
    "tracker_delay": "firm",
}
"""How well an effect's model is known; all others are exact."""


@dataclass(frozen=True)
class Settings:
    """kappa: fraction of what an effect explains that its model leaves, by how well it is known.

    dof: over how many directions that is spread. unknown_dof, unknown_cost: of the hypothesis that
    something else is there. more_cost: of each effect beyond the first. healthy: fraction of noise
    by which a healthy arm's excess may exceed chance. temper: power of the evidence.
    """

    kappa: Mapping[str, float] = field(
        default_factory=lambda: {"exact": 0.03, "firm": 0.06, "loose": 0.2}
    )
    dof: float = 12.0
    unknown_dof: float = 20.0
    unknown_cost: float = 5.0
    effect_cost: float = 5.0
    more_cost: float = 3.0
    healthy: float = 1.0
    temper: float = 0.5

    def kappa_of(self, effect: str) -> float:
        """Return an effect's."""
        return float(self.kappa[KNOWN.get(effect, "exact")])


def load_settings() -> Settings:
    """Return those of the package's calibration."""
    file = resources.files(__package__) / "calibration.json"
    if not file.is_file():
        return Settings()
    return Settings(**json.loads(file.read_text(encoding="utf-8"))["settings"])


_INPUTS_FREE = 0.8
_FULL, _REST = 30.0, 0.1


@dataclass(frozen=True)
class Scored:
    """What a posterior needs of a hypothesis, and nothing else (so that settings can be fitted).

    names; energy: what it leaves over the noise; shares: the energy that each effect explains;
    occam: 1/2 log det.
    """

    names: tuple[str, ...]
    energy: float
    shares: tuple[float, ...]
    occam: float


@dataclass(frozen=True)
class Probabilities:
    """probability of each hypothesis in the order given, of none and unknown; by effect."""

    hypotheses: tuple[float, ...]
    none: float
    unknown: float
    effects: dict[str, float]


def scored(found: Found, left: float) -> list[Scored]:
    """Hypotheses as a posterior sees them; left: structure that the best one leaves."""
    best = min(hypothesis.cost for hypothesis in found.hypotheses)
    out = []
    for hypothesis in found.hypotheses:
        occam = 0.5 * (found.none.cost - hypothesis.cost) - hypothesis.log_bayes
        energy = hypothesis.cost - best + left
        out.append(
            Scored(
                hypothesis.names,
                energy,
                hypothesis.energies_explained(),
                float(occam) * _counted(hypothesis),
            )
        )
    return out


def _counted(hypothesis: Hypothesis) -> float:
    """How much of Occam's factor counts against "unknown", which pays for no input.

    Loads beyond a clipped axis are inputs that were not measured, two a push, and no part of the
    effect; all listed effects but this one get them from the reading for nothing.
    """
    inputs = sum(
        len(values)
        for part, values in zip(hypothesis.parts, hypothesis.values, strict=True)
        if part.inputs
    )
    total = sum(len(values) for values in hypothesis.values)
    return 1.0 - _INPUTS_FREE * inputs / max(total, 1)


def _bent(occam: float) -> float:
    """Occam's factor with what lies beyond _FULL counted less.

    A bias drift of any shape takes a hundred numbers, because it is one; "unknown" has a few
    directions whatever it is of, and would be cheaper than the truth.
    """
    return occam if occam < _FULL else _FULL + _REST * (occam - _FULL)


def posterior(of: Sequence[Scored], settings: Settings) -> Probabilities:
    """Probabilities."""
    none = next(one for one in of if not one.names)
    logs = np.array([_log(one, one.energy, none.energy, settings) for one in of])
    costs = np.array([_cost(len(one.names), settings) for one in of])
    # Evidence is tempered, what is likely beforehand is not.
    everything = settings.temper * logs - costs
    left = min(one.energy for one in of)
    beside = [
        settings.temper * _log_beside(one, left, none.energy, settings) - cost
        for one, cost in zip(of, costs, strict=True)
    ]
    everything = np.append(everything, max(beside) - settings.unknown_cost)
    weights = np.exp(everything - logsumexp(everything))
    effects: dict[str, float] = {}
    for one, weight in zip(of, weights, strict=False):
        for name in one.names:
            effects[name] = effects.get(name, 0.0) + float(weight)
    # Sums of many that are one but for rounding.
    effects = {name: min(1.0, chance) for name, chance in effects.items()}
    at_none = sum(float(w) for one, w in zip(of, weights, strict=False) if not one.names)
    return Probabilities(
        tuple(float(w) for w in weights[:-1]), at_none, float(weights[-1]), effects
    )


def _log_beside(one: Scored, left: float, before: float, settings: Settings) -> float:
    """Of something unlisted beside a hypothesis; all that is there, where there is no other."""
    taken = left if one.names else one.energy
    spread = 1.0 + np.log(max(taken / settings.unknown_dof, 1.0))
    return _log(one, one.energy - taken, before, settings) - 0.5 * float(
        settings.unknown_dof * spread
    )


def _log(one: Scored, energy: float, before: float, settings: Settings) -> float:
    """Of a hypothesis, with so much energy left that it has to answer for."""
    if not one.names:
        return -0.5 * energy / (1.0 + settings.healthy)
    explained = sum(
        settings.kappa_of(name) ** 2 * min(share, before)
        for name, share in zip(one.names, one.shares, strict=True)
    )
    extra = explained / settings.dof
    spread = energy / (1.0 + extra) + settings.dof * np.log1p(extra)
    return -0.5 * float(spread) - _bent(one.occam)


def _cost(effects: int, settings: Settings) -> float:
    """Minus the log of how likely so many effects are beforehand, none being 0."""
    return settings.effect_cost + settings.more_cost * (effects - 1) if effects else 0.0
