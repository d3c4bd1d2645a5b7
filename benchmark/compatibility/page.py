"""The page of the tested environments, from the records of the packages."""

import re
from collections.abc import Mapping
from statistics import mean
from typing import Any

from benchmark.common.tables import markdown_table
from benchmark.compatibility.package_types import Environment, Package
from benchmark.compatibility.packages import PACKAGES

HEADER = ("environment", "policy, buffer, wrappers", "trains", "resumes", "exports", "steps/s", "learns")
TOP = """\
# Tested environments

CGP trains on the environments of these packages from PyPI. Make an environment by the code of its package's section, and
pass it to `CGP(policy, env)`, with the policy and the `replay_buffer_class` that the table names. For an environment that is
not in the table, see [your own environment](environments.md).
"""
NOTES = """\
- **trains**: CGP was trained for 220 steps, 110 of them random, with its default networks and batch size and a small replay
  buffer. The model then predicted actions within the bounds, was saved, and predicted the same when it was loaded.
- **resumes**: a training that was stopped after step 163, and resumed by another process, was compared with one that was not
  stopped. "bit for bit": both end with identical networks, optimizers, replay buffer and counters. "from a new episode": the
  environment's state cannot be restored, so that the resumed training begins a new episode, and a warning says so.
  "differs": the trainings differ without a warning. `replayed` restores an environment by [repeating the interrupted
  episode](environments.md#simulators-whose-state-cannot-be-read); without it, the training is resumed from a new episode.
- **exports**: `model.export` worked. In brackets: the largest difference between the actions of `predict` and those of the
  exported policy, as a share of the action space's width.
- **steps/s**: environment steps per second of processor time, on one thread, with one gradient step per step. In brackets:
  the environment alone, with random actions. Where the load average of a section exceeds the number of cores, both are too
  low.
- **learns**: the mean return of 20 episodes, first by random actions, then by the actor after a training of that many steps;
  and how many of the episodes were successful, where the environment reports it. The arguments are in
  `benchmark/compatibility/packages.py`.
- "–": not checked, or the check was interrupted. A "+" after a commit: files differed from it.

`make test-environments` installs each package into a virtual environment of its own, repeats the checks, and writes the
records and this page to `results/environments/environments.md`.
"""
NEXT = "Next: [your own environment](environments.md), [stop and resume](resuming.md), [on a robot](robot.md).\n"
UNKNOWN = "–"


def page(records: Mapping[str, dict[str, Any]]) -> str:
    """
    Write the page.

    :param records: the packages' records by name
    :return: the page in Markdown
    """
    known = [package for package in PACKAGES if package.name in records]
    rows = [row for package in known for row in _rows(package, records[package.name])]
    sections = [_section(package, records[package.name]) for package in known]
    missing = [package.name for package in PACKAGES if package.name not in records]
    return "\n".join(
        [
            TOP,
            markdown_table(HEADER, rows, align="left"),
            "",
            NOTES,
            *([f"Not tested yet: {', '.join(missing)}.\n"] if missing else []),
            *sections,
            NEXT,
        ]
    )


def _rows(package: Package, record: dict[str, Any]) -> list[list[str]]:
    """Return a row for each of the package's environments."""
    rows = []
    for environment in package.environments:
        found = record["environments"].get(environment.id)
        name = f"{package.name}: {environment.id}"
        if found is None:
            reason = "not installed" if "failure" in record["installation"] else "not tested"
            rows.append([name, _parts(environment), reason, *[UNKNOWN] * 4])
        else:
            rows.append([name, _parts(environment), *_cells(environment, found)])
    return rows


def _parts(environment: Environment) -> str:
    """Return the policy, the replay buffer and the wrappers."""
    return ", ".join(filter(None, (environment.policy, environment.replay_buffer, environment.wrappers)))


def _cells(environment: Environment, found: dict[str, Any]) -> list[str]:
    """Return what was found of an environment."""
    errors = found["errors"].get("whole", {})
    if {"starts", "trains"} & errors.keys():
        return ["no", *[UNKNOWN] * 4]
    failed = [name for name in ("predicts", "saves and loads") if name in errors]
    trains = f"yes, but: {', '.join(failed)}" if failed else "yes"
    # Without an error, the check was interrupted
    resumes = found["resumes"] or ("no" if {"stopped", "resumed"} & found["errors"].keys() else UNKNOWN)
    largest = found.get("export_difference")
    return [trains, resumes, "no" if largest is None else f"yes ({largest:.0e})", _speed(found), _learns(environment, found)]


def _speed(found: dict[str, Any]) -> str:
    training, alone = (found.get(f"{kind}steps_per_second") for kind in ("", "environment_"))
    return UNKNOWN if training is None else f"{training:,.0f}" + (f" ({alone:,.0f})" if alone is not None else "")


def _learns(environment: Environment, found: dict[str, Any]) -> str:
    """Return the returns of random actions and of the actor."""
    if environment.learning is None:
        return "not tested"
    if found.get("returns") is None:
        return UNKNOWN
    random, actor = (f"{mean(found[key]):.1f}" for key in ("random_returns", "returns"))
    successes = "" if found["successes"] is None else f"; {found['random_successes']} → {found['successes']} of 20"
    return f"{random} → {actor}{successes} ({environment.learning.steps:,} steps)"


def _section(package: Package, record: dict[str, Any]) -> str:
    """Return the section of a package."""
    lines = [f"## {package.name}", "", f"`pip install {' '.join(map(_quoted, package.requirements))}`", ""]
    lines += ["```py", _code(package), "```", ""]
    installation = record["installation"]
    if "failure" in installation:
        lines.append(f"- It was not installed: {installation['failure']}")
    elif record["environments"]:
        versions = ", ".join(f"{name} {record['versions'].get(name, 'missing')}" for name in package.distributions)
        lines.append(f"- Tested: {versions}, with Python {record['python']}. {_pins(record)}")
    lines += [f"- {note}" for note in package.notes]
    for environment in package.environments:
        facts = [*environment.notes, *_facts(record["environments"].get(environment.id, {}))]
        if len(package.environments) > 1 and facts:
            facts = [f"**{environment.id}**: {' '.join(facts)}"]
        lines += [f"- {fact}" for fact in facts]
    lines += ["", _conditions(record)]
    return "\n".join(lines) + "\n"


def _code(package: Package) -> str:
    """Return the code that makes the package's environments: if each takes one line, all imports, and then these lines."""
    parts = [environment.code.rpartition("\n\n") for environment in package.environments]
    if len(parts) == 1 or any("\n" in last for _, _, last in parts):
        return "\n\n\n".join(environment.code for environment in package.environments)
    imports = dict.fromkeys(line for first, _, _ in parts for line in first.splitlines() if line)
    # As isort has them: the project's own imports are a block of their own
    own = [line for line in imports if line.startswith("from sb3_cgp")]
    others = sorted((line for line in imports if line not in own), key=lambda line: (line.startswith("from"), line))
    return "\n".join([*others, *([""] if own else []), *own, "", *(last for _, _, last in parts)])


def _conditions(record: dict[str, Any]) -> str:
    """Return where the package was tested."""
    load = "" if record.get("load_average") is None else f", load average {record['load_average']:.0f}"
    return f"Commit {record['commit']}, on {record['machine']['cpu']}, {record['machine']['cores']} cores{load}."


def _quoted(requirement: str) -> str:
    """Return a requirement as a shell takes it."""
    return f'"{requirement}"' if set("[]<>") & set(requirement) else requirement


def _pins(record: dict[str, Any]) -> str:
    """Return how the versions compare with those of ``constraints.txt``."""
    if record["installation"]["pins"] == "all":
        return "No version differs from constraints.txt."
    others = ", ".join(f"{name} {found} (there {pinned})" for name, (found, pinned) in record["other_versions"].items())
    return f"The package contradicts constraints.txt. Other than there: {others or 'nothing'}."


def _facts(found: dict[str, Any]) -> list[str]:
    """Return what was noticed in the check, as sentences."""
    facts = []
    if "observations" in found:
        observations, actions = (_space(found[key]) for key in ("observations", "actions"))
        facts.append(f"Observations: `{observations}`; actions: `{actions}`.")
    if found.get("repeats") is False:
        facts.append("Two trainings with one seed differ: the environment does not repeat itself.")
    if found.get("why_not_restorable") is not None:
        facts.append(f"Not restored: {_reason(found['why_not_restorable'])}")
    for errors in found.get("errors", {}).values():
        facts += [f"Failed ({step}): {error}" for step, error in errors.items()]
    return facts


def _space(text: str) -> str:
    """Return the description of a space without the arrays of its bounds."""
    return re.sub(r"\[[^][]*\]", "[...]", text)


def _reason(text: str) -> str:
    """Return why an environment is not restored, in fewer words where classes are unknown."""
    unknown = re.findall(r"([\w.]+) is unknown and has no get_training_state\(\)", text)
    if not unknown:
        return text
    return f"the state of {', '.join(unknown)} is unknown ([what helps](environments.md#environments-of-other-packages))."
