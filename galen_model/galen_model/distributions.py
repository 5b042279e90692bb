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
    """Compute the probability that chi-square exceeds a value.

    Args:
        value: at least 0.
        freedom: degrees of freedom.

    Returns:
        Probability, 0 to 1.

    """
    return chdtrc(freedom, value)


def chi2_isf(probability: Any, freedom: Any) -> Any:
    """Compute the value that chi-square exceeds with a probability.

    Args:
        probability: of larger values, 0 to 1.
        freedom: degrees of freedom.

    Returns:
        The value, the inverse of `chi2_sf`.

    """
    return chdtri(freedom, probability)


def chi2_ppf(probability: Any, freedom: Any) -> Any:
    """Compute the value below which chi-square stays with a probability.

    Args:
        probability: of smaller values, 0 to 1.
        freedom: degrees of freedom.

    Returns:
        The quantile.

    """
    return 2.0 * gammaincinv(0.5 * freedom, probability)


def noncentral_chi2_sf(value: Any, freedom: Any, noncentrality: Any) -> Any:
    """Compute the probability that noncentral chi-square exceeds a value.

    Args:
        value: at least 0.
        freedom: degrees of freedom.
        noncentrality: sum of the squared means.

    Returns:
        Probability, 0 to 1.

    """
    return 1.0 - chndtr(value, freedom, noncentrality)


def f_ppf(probability: Any, freedom_above: Any, freedom_below: Any) -> Any:
    """Compute the value below which Fisher's F stays with a probability.

    Args:
        probability: of smaller values, 0 to 1.
        freedom_above: degrees of freedom of the numerator.
        freedom_below: degrees of freedom of the denominator.

    Returns:
        The quantile.

    """
    return fdtri(freedom_above, freedom_below, probability)


def normal_ppf(probability: Any) -> Any:
    """Compute the value below which a standard normal variable stays with a probability.

    Args:
        probability: of smaller values, 0 to 1.

    Returns:
        The quantile.

    """
    return ndtri(probability)


def student_t_logpdf(value: Any, freedom: Any, scale: Any) -> Any:
    """Compute the log density of Student's t, stretched by a scale.

    Args:
        value: where, in the scale's unit; elements broadcast.
        freedom: degrees of freedom.
        scale: above 0.

    Returns:
        Natural logarithm of the density, per unit of `value`.

    """
    z = value / scale
    return (
        gammaln(0.5 * (freedom + 1.0))
        - gammaln(0.5 * freedom)
        - 0.5 * np.log(np.pi * freedom)
        - 0.5 * (freedom + 1.0) * np.log1p(z * z / freedom)
        - np.log(scale)
    )
