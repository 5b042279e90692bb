# SPDX-License-Identifier: Apache-2.0
"""Quantiles and tail probabilities of the distributions that the fits and checks need.

`scipy.stats` has them too, but takes three quarters of a second of CPU to be imported, in every
node and command; these are the functions of `scipy.special` that it calls itself, under its names.
All take and return floats or arrays, elementwise; degrees of freedom need not be whole.
"""

from typing import Any

import numpy as np
from scipy.special import chdtrc, chdtri, chndtr, fdtri, gammaincinv, gammaln, ndtri


def chi2_sf(value: Any, freedom: Any) -> Any:
    """Probability that chi-square with these degrees of freedom is larger than value."""
    return chdtrc(freedom, value)


def chi2_isf(probability: Any, freedom: Any) -> Any:
    """Value that chi-square exceeds with this probability."""
    return chdtri(freedom, probability)


def chi2_ppf(probability: Any, freedom: Any) -> Any:
    """Value below which chi-square stays with this probability."""
    return 2.0 * gammaincinv(0.5 * freedom, probability)


def noncentral_chi2_sf(value: Any, freedom: Any, noncentrality: Any) -> Any:
    """Probability that noncentral chi-square (sum of squared means: noncentrality) is larger."""
    return 1.0 - chndtr(value, freedom, noncentrality)


def f_ppf(probability: Any, freedom_above: Any, freedom_below: Any) -> Any:
    """Value below which Fisher's F stays with this probability."""
    return fdtri(freedom_above, freedom_below, probability)


def normal_ppf(probability: Any) -> Any:
    """Value below which a standard normal variable stays with this probability."""
    return ndtri(probability)


def student_t_logpdf(value: Any, freedom: Any, scale: Any) -> Any:
    """Log density of Student's t, stretched by scale, at value."""
    z = value / scale
    return (
        gammaln(0.5 * (freedom + 1.0))
        - gammaln(0.5 * freedom)
        - 0.5 * np.log(np.pi * freedom)
        - 0.5 * (freedom + 1.0) * np.log1p(z * z / freedom)
        - np.log(scale)
    )
