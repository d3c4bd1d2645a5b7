"""Markdown tables, as tests read them."""

import re


def unpadded(text: str) -> str:
    """Return the text with one space in place of several, as cells are padded to the width of their column."""
    return re.sub(r" {2,}", " ", text)
