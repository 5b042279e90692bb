# SPDX-License-Identifier: Apache-2.0
"""Goals on the arm: moving it, the action's skeleton and client."""
