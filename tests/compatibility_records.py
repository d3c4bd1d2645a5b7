"""What the check of another package's environments writes, and the table of its page."""

WRITTEN = {
    "errors": {},
    "warnings": [],
    "doing": None,
    "versions": {"works": "1.2", "numpy": "0.9", "torch": "2.13.0+cpu"},
    "python": "3.11.7",
    "observations": "Box(3,)",
    "actions": "Box(1,)",
    "at_stop": {"a": "1"},
    "at_end": {"a": "2"},
    "why_not_restorable": None,
    "steps_per_second": 80.4,
    "environment_steps_per_second": 12_345.6,
    "export_difference": 0.0,
}


def rows_of(text: str) -> dict[str, list[str]]:
    """The table's cells by environment."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")]
    return {name: cells for name, *cells in rows}
