# SPDX-License-Identifier: Apache-2.0
"""The page: header, tabs and elements."""
