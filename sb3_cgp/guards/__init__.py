"""Errors that name the cause where an environment fails or a value is not a number."""
