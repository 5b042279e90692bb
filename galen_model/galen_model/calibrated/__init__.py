# SPDX-License-Identifier: Apache-2.0
"""What follows from a calibration file: readings, how causes change them, cable and inertia."""
