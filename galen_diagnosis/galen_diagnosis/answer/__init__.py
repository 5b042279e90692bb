# SPDX-License-Identifier: Apache-2.0
"""The answer: gap, localization, parameters, sentence."""
