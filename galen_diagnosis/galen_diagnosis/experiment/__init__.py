# SPDX-License-Identifier: Apache-2.0
"""The next experiment: what would separate the causes that are left."""
