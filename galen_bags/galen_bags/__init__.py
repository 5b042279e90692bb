"""Bags in and out: read into arrays, record, play, work through many."""
