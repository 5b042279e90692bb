# SPDX-License-Identifier: Apache-2.0
"""The Galen's geometry, kinematics, stiffness and URDF."""
