"""Tables in Markdown."""

from collections.abc import Sequence

from pytablewriter import MarkdownTableWriter
from pytablewriter.style import Style


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], align: str = "right") -> str:
    """
    Lay out a table whose first column is aligned to the left.

    :param header: the columns' titles
    :param rows: the cells of each row
    :param align: "left" or "right", the alignment of all other columns
    :return: the table in Markdown
    """
    writer = MarkdownTableWriter(
        headers=header,
        value_matrix=rows,
        # Numbers keep the digits that they were formatted with
        type_hints=["str"] * len(header),
        column_styles=[Style(align="left"), *[Style(align=align)] * (len(header) - 1)],
        margin=1,
    )
    return writer.dumps().rstrip("\n")
