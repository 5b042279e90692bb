# SPDX-License-Identifier: Apache-2.0
"""A node as a process: lifecycle, diagnostics, spinning, background work."""
