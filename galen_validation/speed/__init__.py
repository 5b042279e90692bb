# SPDX-License-Identifier: Apache-2.0
"""Speed of nodes, kernels, start-up and recordings, each beside a baseline."""
