# SPDX-License-Identifier: Apache-2.0
"""The distributions' functions against scipy.stats."""

import numpy as np
import pytest
from scipy import stats

from galen_model import distributions as ours

FREEDOM = np.array([1.0, 4.0, 6.0, 37.5, 3000.0])[:, None]
PROBABILITY = np.array([1e-9, 1e-3, 0.025, 0.5, 0.975, 0.9999])
VALUE = np.array([0.01, 1.0, 7.0, 60.0, 3100.0])


@pytest.mark.parametrize(
    ("found", "wanted"),
    [
        (ours.chi2_sf(VALUE, FREEDOM), stats.chi2.sf(VALUE, FREEDOM)),
        (ours.chi2_isf(PROBABILITY, FREEDOM), stats.chi2.isf(PROBABILITY, FREEDOM)),
        (ours.chi2_ppf(PROBABILITY, FREEDOM), stats.chi2.ppf(PROBABILITY, FREEDOM)),
        (ours.f_ppf(PROBABILITY, 6, FREEDOM), stats.f.ppf(PROBABILITY, 6, FREEDOM)),
        (ours.normal_ppf(PROBABILITY), stats.norm.ppf(PROBABILITY)),
        (
            ours.student_t_logpdf(VALUE, FREEDOM, 0.3),
            stats.t.logpdf(VALUE, FREEDOM, scale=0.3),
        ),
    ],
)
def test_they_are_scipys(found, wanted):
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-300)


def test_noncentral_chi2_is_scipys_where_a_power_is_asked_for():
    sizes = np.array([0.1, 3.0, 20.0, 200.0])
    wanted = stats.ncx2.sf(16.8, 6, sizes)
    np.testing.assert_allclose(ours.noncentral_chi2_sf(16.8, 6, sizes), wanted, rtol=1e-7)
