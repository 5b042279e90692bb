# SPDX-License-Identifier: Apache-2.0
"""The forms in which effects are tried on a recording."""
