"""Environments of other packages with CGP: which are tested, how they are installed and checked, and the page of results."""
