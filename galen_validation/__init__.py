# SPDX-License-Identifier: Apache-2.0
"""Speed, endurance and long validation; not installed."""
