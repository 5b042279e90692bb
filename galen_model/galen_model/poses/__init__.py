# SPDX-License-Identifier: Apache-2.0
"""Still poses: grids, poses chosen for information, their order and the ways between them."""
