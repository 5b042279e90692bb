# SPDX-License-Identifier: Apache-2.0
"""Models of the deflection behind one interface."""
