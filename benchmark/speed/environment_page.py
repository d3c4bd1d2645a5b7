"""The page on the ways of stepping many environments."""

from typing import Any

from benchmark.common.provenance import conditions_in_words
from benchmark.common.tables import markdown_table

NOTES = """\
Steps of {env} per second of all environments together, by random actions: median (quartiles) of {rounds} rounds of
{steps} steps of each environment, in which all ways of a number of environments take turns. "/ subproc" is the speed as a
ratio to SB3's `SubprocVecEnv`, the median of the ratios within each round. A load by other programs slows the ways that have
more processes more, so that ratios from a busy machine are rough: see the load average below. "processor, us" is the time of
a processor per step of an environment, of all processes together: simulator, messages and Python, without waiting. "start, s"
is the time to make and reset the environments. "A process per core" means {processes} of them. The ways of other libraries are
adapted to SB3's `VecEnv`, and give no other infos than those of episodes' ends. EnvPool has its own copy of MuJoCo: its
trajectories are not Gymnasium's."""


def markdown(record: dict[str, Any]) -> str:
    """
    Write the page.

    :param record: the measurements and their conditions
    :return: tables and notes, in Markdown
    """
    header = ["environments", "way", "steps/s", "/ subproc", "processor, us", "start, s"]
    rows = [_row(point) for point in record["points"]]
    notes = NOTES.format(**{name: record[name] for name in ("env", "rounds", "steps", "processes")})
    table = markdown_table(header, rows)
    return "\n\n".join(["# Environments in step", table, notes, conditions_in_words(record)]) + "\n"


def _row(point: dict[str, Any]) -> list[str]:
    start = [str(point["n_envs"]), point["title"]]
    if "missing" in point:
        return [*start, point["missing"], "", "", ""]
    speed, processor = point["steps_per_second"], point["processor_microseconds_per_step"]
    return [
        *start,
        f"{speed['median']:,.0f} ({speed['lower']:,.0f}-{speed['upper']:,.0f})",
        "-" if point["ratio"] is None else f"{point['ratio']:.2f}",
        "-" if processor is None else f"{processor['median']:.0f}",
        f"{point['start_seconds']:.1f}",
    ]
