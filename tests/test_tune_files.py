"""Writing an entry into a YAML file, in which nothing else changes."""

from functools import partial

import pytest

from benchmark.sweeps.entries import check_file, write_entry

OTHERS = """# What this file is
Ant-v5: &ant  # the ant
  gamma: 0.98

# About the pendulum

Pendulum-v1:
  gamma: 0.9
  # of the rate
  learning_rate: !!float 1e-3

# About the hopper
Hopper-v5:
  <<: *ant
"""


def test_an_entry_is_replaced_and_nothing_else(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(OTHERS)
    write_entry(path, "Pendulum-v1", {"gamma": 0.5, "policy_kwargs": "dict(net_arch=[8])"}, "tuned")
    old = OTHERS[OTHERS.index("Pendulum-v1") : OTHERS.index("\n\n# About the hopper")]
    new = "Pendulum-v1:\n  # tuned\n  gamma: 0.5\n  policy_kwargs: dict(net_arch=[8])"
    assert path.read_text() == OTHERS.replace(old, new)
    write_entry(path, "Pendulum-v1", {"gamma": 0.6}, "tuned again")
    assert path.read_text() == OTHERS.replace(old, "Pendulum-v1:\n  # tuned again\n  gamma: 0.6")


def test_a_link_stays_one_and_lines_end_as_they_did(tmp_path):
    (tmp_path / "real.yml").write_bytes(b"# Mine\r\nAnt-v5:\r\n  gamma: 0.9\r\n")
    (tmp_path / "mine.yml").symlink_to("real.yml")
    write_entry(tmp_path / "mine.yml", "Hopper-v5", {"gamma": 0.5}, "tuned")
    assert (tmp_path / "mine.yml").is_symlink()
    assert (tmp_path / "real.yml").read_bytes() == (
        b"# Mine\r\nAnt-v5:\r\n  gamma: 0.9\r\nHopper-v5:\r\n  # tuned\r\n  gamma: 0.5\r\n"
    )


@pytest.mark.parametrize("before", [None, "", "# Nothing yet\n", OTHERS, OTHERS.rstrip("\n")])
def test_an_entry_is_added(tmp_path, before):
    path = tmp_path / "folder" / "mine.yml"
    if before is not None:
        path.parent.mkdir()
        path.write_text(before)
    check_file(path, "Reacher-v5")
    assert (path.read_text() if path.exists() else None) == before
    write_entry(path, "Reacher-v5", {"gamma": 0.5}, "tuned")
    kept = "" if not before else before.rstrip("\n") + "\n"
    assert path.read_text() == kept + "Reacher-v5:\n  # tuned\n  gamma: 0.5\n"


@pytest.mark.parametrize(
    "before",
    [
        OTHERS,
        "{Ant-v5: {gamma: 1}, Hopper-v5: {gamma: 2}}\n",
        "Hopper-v5: {gamma: 2}\n...\n",
        "Ant-v5: {gamma: 1}\nAnt-v5: {gamma: 2}\n",
        "- a\n- list\n",
        "a: [\n",
        "# \udcff\n",
    ],
)
def test_a_file_that_cannot_be_changed_is_left_alone_and_refused_before_the_tuning(tmp_path, before):
    path = tmp_path / "mine.yml"
    path.write_text(before, errors="surrogateescape")
    for change in (partial(check_file, path, "Ant-v5"), partial(write_entry, path, "Ant-v5", {"gamma": 0.5}, "tuned")):
        with pytest.raises(ValueError, match=r"mine.yml is (not changed|no YAML file)"):
            change()
    assert path.read_text(errors="surrogateescape") == before
