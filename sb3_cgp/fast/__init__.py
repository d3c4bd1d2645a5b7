"""Faster ways of doing what the core does."""
