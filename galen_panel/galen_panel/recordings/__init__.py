"""Recordings at hand, jobs on them, and their reports."""
