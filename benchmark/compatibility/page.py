"""The page of the tested environments, from the records of the packages."""

import re
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from benchmark.common.tables import markdown_table
from benchmark.compatibility.package_types import Environment, Package
from benchmark.compatibility.packages import PACKAGES

HEADER = ("environment", "policy, buffer, wrappers", "trains", "resumes", "exports", "steps/s", "learns")
PACKAGE_HEADER = ("package", "`pip install`", "import", "tested versions")
TOP = """\
# Tested environments

CGP trains on the environments of these packages from PyPI. Import the package, make the environment by its name, and pass it
to CGP with the policy and the replay buffer of the table:

```py
import panda_gym
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env

from sb3_cgp import CGP

env = make_vec_env("PandaReach-v3")
model = CGP("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer)
```

Pass the table's wrapper as `wrapper_class`: `replayed`, which [repeats an interrupted
episode](environments.md#simulators-whose-state-cannot-be-read), is in `sb3_cgp.resumption`, and `FlattenObservation` in
`gymnasium.wrappers`. If an environment needs other code, it is [below](#packages). For all others, see [your own
environment](environments.md).
"""
NOTES = """\
- **trains**: CGP trained for 220 steps, was saved and loaded, and acted as before, within the bounds.
- **resumes**: an interrupted training was compared with an uninterrupted one. "bit for bit": networks, optimizers, replay
  buffer and counters are identical at the end. "from a new episode": the state of the environment cannot be restored, and a
  warning names its classes ([what helps](environments.md#environments-of-other-packages)).
- **exports**: in brackets, the largest difference between the actions of `predict` and of the exported policy, as a share of
  the action space's width. Where observations are float64, so are the exported policy's inputs.
- **steps/s**: steps of all environments together per second of processor time, on one thread, with a gradient step of the
  default networks (256 units) after each step. In brackets: the environment alone.
- **learns**: the mean return of 20 episodes, and how many are successful: by random actions → after one training of that many
  steps, with networks of 64 units (arguments: `benchmark/compatibility/packages.py`). It is short: it shows whether returns
  rise, and not which returns the task allows.
- "–": not tested, or interrupted.
"""
REPEAT = """\
`make test-environments` tests each package in a virtual environment of its own, and writes the records and this page to
`results/environments/environments.md`. This repository's records are in `benchmark/results/environments`.
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
            "## Packages\n",
            markdown_table(PACKAGE_HEADER, [_package(package, records[package.name]) for package in known], align="left"),
            "",
            *_conditions([records[package.name] for package in known]),
            REPEAT,
            *filter(None, sections),
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
    # After an error in `predict`, it was not tried
    exports = f"yes ({largest:.0e})" if largest is not None else "no" if "exports" in errors else UNKNOWN
    return [trains, resumes, exports, _speed(found), _learns(environment, found)]


def _speed(found: dict[str, Any]) -> str:
    training, alone = (found.get(f"{kind}steps_per_second") for kind in ("", "environment_"))
    return UNKNOWN if training is None else f"{training:,.0f}" + (f" ({alone:,.0f})" if alone is not None else "")


def _learns(environment: Environment, found: dict[str, Any]) -> str:
    """Return the returns of random actions and of the actor."""
    if environment.learning is None or found.get("returns") is None:
        return UNKNOWN
    random, actor = (f"{mean(found[key]):.1f}" for key in ("random_returns", "returns"))
    successes = "" if found["successes"] is None else f"; {found['random_successes']} → {found['successes']} of 20"
    return f"{random} → {actor}{successes} ({environment.learning.steps:,} steps)"


def _package(package: Package, record: dict[str, Any]) -> list[str]:
    """Return a package's row: what pip installs, the import that registers the environments, and the versions."""
    requirements = f"`{' '.join(map(_quoted, package.requirements))}`"
    if any(_code(environment) == environment.code for environment in package.environments):
        imported = f"[code](#{package.name})"
    else:
        imported = ", ".join(f"`{name}`" for name in re.findall(r"^import (\w+)$", package.environments[0].code, re.MULTILINE))
    versions = ", ".join(f"{name} {record['versions'].get(name, 'missing')}" for name in package.distributions)
    tested = "not installed" if "failure" in record["installation"] else versions if record["environments"] else UNKNOWN
    return [package.name, requirements, imported or UNKNOWN, tested]


def _section(package: Package, record: dict[str, Any]) -> str:
    """Return the section of a package: code other than the usual, and what to know; empty if there is neither."""
    code = "\n\n\n".join(filter(None, map(_code, package.environments)))
    installation = record["installation"]
    lines = []
    if "failure" in installation:
        lines.append(f"It was not installed: {installation['failure']}")
    elif record["environments"] and installation["pins"] != "all":
        lines.append(_pins(record))
    lines += package.notes
    # A fact that several environments share is stated once
    facts: dict[str, list[str]] = {}
    for environment in package.environments:
        for fact in (*environment.notes, *_facts(record["environments"].get(environment.id, {}))):
            facts.setdefault(fact, []).append(environment.id)
    for fact, ids in facts.items():
        lines.append(fact if len(ids) == len(package.environments) else f"**{', '.join(ids)}**: {fact}")
    parts = [*([f"```py\n{code}\n```\n"] if code else []), *(["".join(f"- {line}\n" for line in lines)] if lines else [])]
    return "\n".join([f"## {package.name}\n", *parts]) if parts else ""


def _code(environment: Environment) -> str:
    """Return the code that makes an environment, without what is said for all: imports, and the name and wrapper alone."""
    found = re.fullmatch(r'(?:(?:import|from) .+\n|\n)*(env = make_vec_env\("[^"]+"(.*)\))', environment.code)
    if found is None:
        return environment.code
    return "" if re.fullmatch(r"(, wrapper_class=\w+)?", found[2]) else found[1]


def _conditions(records: Sequence[dict[str, Any]]) -> list[str]:
    """Return where the packages were tested, and which speeds are too low."""
    tested = [record for record in records if record["environments"]]
    if not tested:
        return []
    machines = dict.fromkeys(
        f"{record['machine']['cpu']}, {record['machine']['cores']} cores, with Python {record['python']}" for record in tested
    )
    busy = [record["package"] for record in tested if (record.get("load_average") or 0) > record["machine"]["cores"]]
    low = f"The machine also ran other programs: steps/s may be too low for {', '.join(busy)}.\n" if busy else ""
    pins = "Versions are those of `constraints.txt`, unless the package's section says otherwise."
    return [f"Tested on {'; '.join(machines)}. {pins}\n{low}"]


def _quoted(requirement: str) -> str:
    """Return a requirement as a shell takes it."""
    return f'"{requirement}"' if set("[]<>") & set(requirement) else requirement


def _pins(record: dict[str, Any]) -> str:
    """Return which versions are not those of ``constraints.txt``."""
    others = ", ".join(f"{name} {found} (there {pinned})" for name, (found, pinned) in record["other_versions"].items())
    return f"The package contradicts constraints.txt. Other than there: {others or 'nothing'}."


def _facts(found: dict[str, Any]) -> list[str]:
    """Return what was noticed in the check, as sentences."""
    facts = []
    if found.get("repeats") is False:
        facts.append("Two trainings with one seed differ: the environment does not repeat itself.")
    for errors in found.get("errors", {}).values():
        facts += [f"Failed ({step}): {error}" for step, error in errors.items()]
    return facts
