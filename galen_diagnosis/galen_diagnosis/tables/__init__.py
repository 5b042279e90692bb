# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of measured tables and joints."""
