"""A small sweep's command line, and what it is read as."""

from benchmark.sweep import load, parse

SMALL = ["e8", "--task", "Pendulum-v1", "--steps", "400", "--seeds", "1", "--methods", "TD3"]


def of_command_line(*argv):
    args = parse(argv)
    return load(args.name, args), args
