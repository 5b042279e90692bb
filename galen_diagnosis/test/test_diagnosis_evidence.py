"""Evidence of columns against its exact value, and a posterior's behaviour at its edges."""

import numpy as np
import pytest
from galen_diagnosis.inference.posterior import Scored, Settings, posterior
from galen_model.evidence.linear import SCALES, Background, evidence
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
    extended = behind.with_free(more)
    for remembered in (False, True):
        if remembered:
            behind.remember(columns)
        both = extended.reduced(columns, rows), whole.reduced(columns, rows)
        for one, other in zip(*both, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-10)
    assert extended.sum_of_squares(rows) == pytest.approx(whole.sum_of_squares(rows))
    np.testing.assert_allclose(extended.fit(rows), whole.fit(rows), atol=1e-10)


def _scored(name, energy, share, occam=4.0):
    return Scored((name,) if name else (), energy, (share,) if name else (), occam if name else 0.0)


def test_noise_alone_is_none_and_a_clear_effect_is_itself():
    settings = Settings()
    quiet = [_scored("", 3.0, 0.0), _scored("joint_gain:tilt", 0.0, 3.0)]
    assert posterior(quiet, settings).none > 0.9
    clear = [
        _scored("", 900.0, 0.0),
        _scored("joint_gain:tilt", 5.0, 895.0),
        _scored("joint_zero_offset:tilt", 400.0, 500.0),
    ]
    chances = posterior(clear, settings)
    assert chances.effects["joint_gain:tilt"] > 0.99
    total = chances.none + chances.unknown + sum(chances.hypotheses) - chances.none
    assert total == pytest.approx(1.0)


def test_what_nothing_explains_is_unknown():
    of = [_scored("", 5000.0, 0.0), _scored("joint_gain:tilt", 4000.0, 1000.0)]
    assert posterior(of, Settings()).unknown > 0.99


def test_a_second_effect_must_explain_more_than_the_first_law_leaves():
    settings = Settings()
    none = _scored("", 20000.0, 0.0)
    cable = _scored("cable_drag", 300.0, 19700.0, 15.0)
    both = Scored(("cable_drag", "joint_gain:tilt"), 0.0, (19000.0, 300.0), 20.0)
    chances = posterior([none, cable, both], settings)
    # 300 of 20000 is less than a cable's law is known to.
    assert chances.hypotheses[1] > chances.hypotheses[2]
    mass = _scored("tool_mass_error", 3000.0, 17000.0)
    pair = Scored(("tool_mass_error", "joint_gain:tilt"), 0.0, (17000.0, 3000.0), 8.0)
    chances = posterior([none, mass, pair], settings)
    assert chances.hypotheses[2] > 0.99
