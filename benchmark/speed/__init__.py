"""Measurements of run time and precision."""
