"""Wrenches and joint states paired by stamp, and their monitoring."""
