# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from galen_model.estimation.evidence import Background

from galen_validation.blind.answers import parse_answer
from galen_validation.blind.baselines import NAIVE_BIC, RMSE_DROP, explained, simple_answers


def test_what_columns_explain_is_that_of_a_least_squares_fit():
    random = np.random.default_rng(0)
    unknowns, columns = random.normal(size=(300, 4)), random.normal(size=(300, 3))
    residual = random.normal(size=300) + columns @ [0.5, 0.0, -0.3]
    behind = Background(unknowns, np.full(4, np.inf))
    both = np.linalg.lstsq(np.column_stack([unknowns, columns]), residual, rcond=None)[1][0]
    alone = behind.sum_of_squares(residual)
    assert alone == pytest.approx(np.linalg.lstsq(unknowns, residual, rcond=None)[1][0])
    assert explained(behind, columns, residual) == pytest.approx(alone - both)
    # Columns twice, such as the unknowns explain already, and zeros add nothing.
    more = np.column_stack([columns, columns, unknowns[:, :2], np.zeros((300, 2))])
    assert explained(behind, more, residual) == pytest.approx(alone - both)
    assert explained(behind, np.zeros((300, 2)), residual) == 0.0


def test_the_simple_methods_answer_as_they_are_known_to():
    n = 1000
    found = simple_answers(n, 1000.0, {"gain": (995.0, 1), "wide": (960.0, 60)})
    drop, bic = (parse_answer(found[name]) for name in (RMSE_DROP, NAIVE_BIC))
    assert drop.first == "wide" and drop.verdict == "identified"
    # 60 parameters cost 414, and 1 costs 6.9; neither gains as much: none it is.
    assert bic.first == "none" and bic.verdict == "none" and not bic.causes
    assert sum(bic.ranking.values()) == pytest.approx(1.0)
    odds = 0.5 * (n * np.log(1000.0 / 995.0) - np.log(n))
    assert bic.ranking["gain"] / bic.ranking["none"] == pytest.approx(np.exp(odds))
    clear = simple_answers(n, 1000.0, {"gain": (900.0, 1), "wide": (880.0, 60)})
    assert parse_answer(clear[NAIVE_BIC]).first == "gain"
    quiet = parse_answer(simple_answers(n, 1000.0, {"gain": (999.0, 1)})[RMSE_DROP])
    assert quiet.first == "none"
