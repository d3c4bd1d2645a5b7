"""Errors and warnings of other packages, as they can be shown in a table."""

import re

LONGEST = 1_500


def in_a_line(text: str) -> str:
    """
    Return a text in a line, with the names of files in place of their absolute paths.

    :param text: the text
    :return: the text, at most ``LONGEST`` characters
    """
    text = re.sub(r"(?<![\w.:/])(?:file:/+)?/(?:[\w.+@-]+/)+", "", " ".join(text.split()))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
