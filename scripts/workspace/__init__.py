# SPDX-License-Identifier: Apache-2.0
"""Makes the environment and builds the workspace; only the standard library is used."""
