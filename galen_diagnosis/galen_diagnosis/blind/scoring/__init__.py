"""Scores of answers against labels."""
