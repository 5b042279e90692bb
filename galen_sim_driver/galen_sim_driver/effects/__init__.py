# SPDX-License-Identifier: Apache-2.0
"""The effects of the contract's section 6, one a file."""
