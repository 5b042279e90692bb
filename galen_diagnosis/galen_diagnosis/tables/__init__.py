"""Diagnosis of measured tables and joints."""
