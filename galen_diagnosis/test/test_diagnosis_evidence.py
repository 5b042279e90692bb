# SPDX-License-Identifier: Apache-2.0
"""Evidence of columns against its exact value, and a posterior's behaviour at its edges."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from galen_diagnosis.effects.drift import SENSOR_DRIFT
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.inference.discrepancy import (
    Discrepancies,
    Weighed,
    looks_like,
)
from galen_diagnosis.inference.posterior import Scored, Settings, forgiven, posterior
from galen_diagnosis.inference.refine import refine
from galen_model.estimation.evidence import (
    SCALES,
    Background,
    any_shape,
    evidence,
    explained,
)
from galen_sim_driver.effects.sensor import SensorDrift
from scipy.sparse import csc_array, diags_array
from scipy.stats import multivariate_normal


def test_evidence_is_the_ratio_of_the_marginal_likelihoods():
    generator = np.random.default_rng(0)
    nuisance, columns = generator.standard_normal((30, 3)), generator.standard_normal((30, 2))
    prior, typical = np.array([0.5, 2.0, 1.0]), np.array([0.3, 0.7])
    rows = generator.standard_normal(30) + columns @ [0.4, -1.0] + nuisance @ [0.2, 1.0, 0.0]
    behind = Background(nuisance, prior)
    none = np.eye(30) + (nuisance * prior**2) @ nuisance.T
    ratios = []
    for scale in SCALES:
        more = none + (columns * (scale * typical) ** 2) @ columns.T
        zero = np.zeros(30)
        ratios.append(
            multivariate_normal(zero, more).logpdf(rows)
            - multivariate_normal(zero, none).logpdf(rows)
        )
    exact = np.log(np.mean(np.exp(ratios)))
    gram, along = behind.reduced(columns, rows)
    assert evidence(gram, along, typical).log_bayes == pytest.approx(exact, abs=1e-9)


def test_any_shape_is_the_largest_ratio_of_the_marginal_likelihoods():
    generator = np.random.default_rng(1)
    nuisance, columns = generator.standard_normal((30, 2)), generator.standard_normal((30, 4))
    columns[:, 3] = columns[:, 0] - columns[:, 1] + nuisance[:, 0]  # says nothing of its own
    columns /= np.linalg.norm(columns, axis=0)
    rows = generator.standard_normal(30) + columns[:, :3] @ [3.0, -2.0, 1.0] + nuisance @ [5.0, 1.0]
    energy, directions = explained(*Background(nuisance, np.full(2, np.inf)).reduced(columns, rows))
    assert directions == 3
    way = np.linalg.qr(np.hstack([nuisance, columns]))[0][:, 2:5]
    assert energy == pytest.approx(np.sum((way.T @ rows) ** 2))
    plain = multivariate_normal(np.zeros(3), np.eye(3))
    of_way = way.T @ rows
    ratios = [
        multivariate_normal(np.zeros(3), (1.0 + g) * np.eye(3)).logpdf(of_way)
        - plain.logpdf(of_way)
        for g in np.linspace(0.0, 40.0, 4001)
    ]
    assert any_shape(energy, directions) == pytest.approx(max(ratios), abs=1e-5)
    assert any_shape(2.9, 3) == 0.0


def test_sum_of_squares_is_that_of_the_best_fit():
    generator = np.random.default_rng(1)
    columns = generator.standard_normal((40, 4))
    behind = Background(columns, np.array([np.inf, np.inf, 0.1, 1.0]))
    rows = generator.standard_normal(40)
    nu = behind.fit(rows)
    left = rows - columns @ nu
    assert behind.sum_of_squares(rows) == pytest.approx(left @ left + behind.penalty(nu))
    for k in range(4):
        moved = nu.copy()
        moved[k] += 0.05
        worse = rows - columns @ moved
        assert worse @ worse + behind.penalty(moved) > behind.sum_of_squares(rows)


def test_a_background_with_more_columns_is_that_of_all_of_them():
    generator = np.random.default_rng(2)
    nuisance, more, columns = (generator.standard_normal((50, k)) for k in (4, 2, 3))
    rows = generator.standard_normal(50)
    prior = np.array([0.5, np.inf, 1.0, 0.1])
    behind = Background(nuisance, prior)
    whole = Background(
        np.concatenate([nuisance, more], axis=1), np.concatenate([prior, [np.inf] * 2])
    )
    extended = behind.beside(more)
    for remembered in (False, True):
        if remembered:
            behind.remember(columns)
        both = extended.reduced(columns, rows), whole.reduced(columns, rows)
        for one, other in zip(*both, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-10)
    assert extended.sum_of_squares(rows) == pytest.approx(whole.sum_of_squares(rows))
    np.testing.assert_allclose(extended.fit(rows), whole.fit(rows), atol=1e-10)
    # Sparse, with priors of their own; some of its columns; some of the rows.
    known = np.array([0.3, 2.0])
    mixed = behind.beside(csc_array(more), known).beside(columns, 1.0)
    joined, prior = np.concatenate([nuisance, more, columns], axis=1), [*prior, *known, *[1.0] * 3]
    kept = generator.random(50) > 0.3
    for count in (3, 4, 5, 6, 9):
        first, plain = mixed.first(count), Background(joined[:, :count], np.array(prior[:count]))
        np.testing.assert_allclose(first.columns, plain.columns)
        np.testing.assert_allclose(first.fit(rows), plain.fit(rows), atol=1e-10)
        some = first.averaged(diags_array(kept.astype(float), format="csc"))
        plain = Background(joined[:, :count] * kept[:, None], np.array(prior[:count]))
        np.testing.assert_allclose(some.left(rows * kept), plain.left(rows * kept), atol=1e-10)


def _scored(name, energy, occam=4.0):
    return Scored((name,) if name else (), energy, occam if name else 0.0)


def test_noise_alone_is_none_and_a_clear_effect_is_itself():
    settings = Settings()
    quiet = [_scored("", 3.0), _scored("joint_gain:tilt", 0.0)]
    assert posterior(quiet, settings).none > 0.9
    clear = [
        _scored("", 900.0),
        _scored("joint_gain:tilt", 5.0),
        _scored("joint_zero_offset:tilt", 400.0),
    ]
    chances = posterior(clear, settings)
    assert chances.effects["joint_gain:tilt"] > 0.99
    total = chances.none + chances.unknown + sum(chances.hypotheses) - chances.none
    assert total == pytest.approx(1.0)


def test_what_nothing_explains_is_unknown():
    of = [_scored("", 5000.0), _scored("joint_gain:tilt", 4000.0)]
    assert posterior(of, Settings()).unknown > 0.99


def test_structure_that_explains_all_better_than_what_is_listed_is_unknown():
    none, listed = replace(_scored("", 2000.0), structure=900.0), _scored("sensor_drift", 20.0)
    assert posterior([none, listed], Settings()).effects["sensor_drift"] > 0.9
    none = replace(none, structure=998.0)
    assert posterior([none, listed], Settings()).unknown > 0.9


def test_what_a_law_may_be_off_is_in_proportion_to_what_it_does():
    """D D^T has (kappa s)^2 on its diagonal: nothing where the effect does nothing."""
    count = 240
    rows = SimpleNamespace(
        channel=np.arange(count) % 12, bag=np.arange(count) // 80, regime=np.arange(count) % 8,
        block=np.arange(count) // 20, bag_s=np.arange(count) % 80 / 10.0, pose=np.full(count, -1),
    )  # fmt: skip
    signature = np.where(np.arange(count) < 100, np.random.default_rng(3).normal(size=count), 0.0)
    observation = SimpleNamespace(rows=rows, unknowns=1)
    behind = Background(np.zeros((count, 1)), np.ones(1))
    part = SimpleNamespace(effect="cable_drag")
    fit = SimpleNamespace(
        parts=(part,), names=("cable_drag",), effects=(None,), changes=lambda _: [signature]
    )
    off = Discrepancies(observation, behind).of(fit)[0].toarray()
    size = record_of("cable_drag").kappa
    np.testing.assert_allclose(np.sum(off**2, axis=1), (size * signature) ** 2, atol=1e-12)
    assert np.linalg.matrix_rank(off) > 10


def test_numbers_do_not_make_up_for_what_is_fitted_beside():
    """Of 2 s and an offset of the first rows the fit has to find 2."""
    signature, first = np.sin(np.arange(60) / 3.0) + 0.5, (np.arange(60) < 20).astype(float)
    rows = 2.0 * signature + 5.0 * first
    observation = SimpleNamespace(
        unknowns=12, residual=lambda effects, unknown: rows - effects[0][0] * signature
    )
    part = SimpleNamespace(
        effect="backlash", start=np.zeros(1), typical=np.ones(1), columns=signature[:, None],
        bonus=0.0, limits=lambda: (np.full(1, -10.0), np.full(1, 10.0)), at=lambda values: values,
        unsimulated=lambda values: 0.0, jacobian=lambda *_: signature[:, None],
    )  # fmt: skip
    behind = Background(np.zeros((60, 12)), np.ones(12))
    alone = refine(observation, behind, [part], [np.ones(1)])
    beside = refine(
        observation, behind, [part], [np.ones(1)], nuisance=csc_array(9 * first[:, None])
    )
    assert beside.values[0][0] == pytest.approx(2.0, abs=0.05)
    assert abs(alone.values[0][0] - 2.0) > 0.5
    # F counts without what was fitted beside.
    assert beside.cost > alone.cost > 100.0


def test_a_model_that_fits_misses_less():
    part = SimpleNamespace(effect="deflection_hysteresis")
    fit = SimpleNamespace(
        parts=(part,), names=(part.effect,), energies_explained=lambda: (20_000.0,)
    )
    rough, fine = (
        Weighed(fit, [], [], None, None, scale, 0.0, 0.0, 0.0, 0.0) for scale in (1.0, 0.1)
    )
    assert fine.missed() == pytest.approx(0.01 * rough.missed())
    assert rough.answered(30.0) == fine.answered(30.0) < 1.0


def test_a_drift_may_be_as_rough_between_knots_as_it_is_over_them():
    """A random walk's middle between knots is off by a std of half a step's, by Levy."""
    generator = np.random.default_rng(4)
    at_s = np.arange(4000.0)
    walk = np.cumsum(generator.standard_normal((4000, 6)), axis=0)
    knots = at_s[::40]
    drift = SensorDrift.through(knots, walk[::40])
    rows = SimpleNamespace(session_s=at_s)
    hats = SENSOR_DRIFT.between_knots(drift, rows, np.tile(np.eye(6)[0], (4000, 1)))
    allowed = np.sqrt(np.sum(hats.toarray() ** 2, axis=1))
    middle = np.arange(20, 3900, 40)
    off = walk[middle, 0] - np.interp(middle, knots, walk[::40, 0])
    assert np.mean(allowed[middle] ** 2) == pytest.approx(np.mean(off**2), rel=0.5)
    assert np.all(allowed[::40][:-1] < 1e-9)
    straight = SensorDrift.through(knots, np.outer(knots, np.ones(6)))
    assert abs(SENSOR_DRIFT.between_knots(straight, rows, np.ones((4000, 6)))).sum() < 1e-6


def test_only_where_an_effect_acts_may_it_be_taken_for_another():
    loud = np.where(np.arange(1000) < 500, 3.0, 0.0)
    same, elsewhere = loud / 10.0, 0.3 * (loud == 0.0)
    assert looks_like([("backlash", loud)], same) > 0.85
    assert looks_like([("backlash", loud)], elsewhere) == 0.0
    assert looks_like([("tool_mass_error", loud)], same) < 0.05
    assert 0.0 < looks_like([("backlash", loud)], same + elsewhere) < 0.6


def test_structure_that_was_found_is_evidence_for_something_unlisted():
    def unknown(structure):
        left = 2.0 * structure
        gain = _scored("joint_gain:tilt", left)
        return posterior([Scored((), left + 1.0, 0.0, structure), gain], Settings()).unknown

    assert unknown(30.0) > 0.9 > 0.1 > unknown(0.0)


def test_a_second_effect_keeps_its_evidence_beside_a_large_one():
    of = [_scored("", 20000.0), _scored("tool_mass_error", 300.0)]
    of.append(Scored(("tool_mass_error", "joint_gain:tilt"), 0.0, 8.0))
    assert posterior(of, Settings()).hypotheses[2] > 0.99


def test_an_effect_that_explains_less_than_what_the_others_models_miss_is_no_cause():
    both, alone, other = ("cable_drag", "inertial_load"), ("cable_drag",), ("inertial_load",)
    of = [Scored(both, 10.0, 55.0), Scored(alone, 130.0, 51.0), Scored(other, 2e5, 4.0)]
    of.append(Scored((), 2e5, 0.0))
    assert posterior(of, Settings()).effects["inertial_load"] > 0.99
    assert posterior(forgiven(of, 60.0), Settings()).effects["inertial_load"] > 0.9
    found = forgiven(of, 500.0)
    assert [one.energy for one in found] == [10.0, 10.0, 2e5 - 500.0, 2e5]
    assert forgiven([of[0], Scored(alone, 3.0, 51.0)], 0.0)[1].energy == 3.0, "none gets worse"
    chances = posterior(found, Settings()).effects
    assert chances["inertial_load"] < 0.05
    assert chances["cable_drag"] > 0.99
