# SPDX-License-Identifier: Apache-2.0
"""The operator's panel in the browser: tools, behaviours, compensation, live plots, recordings."""
