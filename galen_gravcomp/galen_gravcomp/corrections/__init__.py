# SPDX-License-Identifier: Apache-2.0
"""The corrections that are subtracted from a wrench."""
