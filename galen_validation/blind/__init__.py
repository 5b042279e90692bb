# SPDX-License-Identifier: Apache-2.0
"""The blind check: recordings with a hidden cause, sealed labels, scores."""
