# SPDX-License-Identifier: Apache-2.0
"""Training, scores and comparison of models."""
