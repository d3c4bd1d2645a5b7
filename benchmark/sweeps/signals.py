"""
How the processes of a sweep handle signals that ask them to end.

A handler ends its process by an exception. Python prints an exception that is raised within a finalizer or within the callback
of a weak reference, as in a library's cleanup, and goes on. Handlers therefore note their signals, and every loop of such a
process calls :func:`end_if_asked`, which raises the exception again.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from sb3_cgp.resumption.signals import StopSignals

# The exit code of a process that ended because of SIGTERM
TERMINATED = 128 + signal.SIGTERM
# The signals that have asked this process to end, in their order
_noted: list[int] = []


def end_if_asked() -> None:
    """
    End the process if a signal has asked for it.

    :raises SystemExit: after SIGTERM
    :raises KeyboardInterrupt: after Ctrl-C
    """
    if _noted:
        _end(_noted[0])


def handle_as_command() -> None:
    """Handle signals as a command that starts processes: SIGTERM and Ctrl-C end them before the command."""
    signal.signal(signal.SIGTERM, _terminate)
    # What a shell has put into the background ignores Ctrl-C
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def handle_as_worker(parent: int | None) -> None:
    """
    Handle signals as a process that trains: on SIGTERM its run is saved and given back.

    :param parent: the process that started this one; None for a process started by hand
    """
    signal.signal(signal.SIGTERM, _terminate)
    # Ctrl-C in a terminal reaches all of its processes: the parent then ends this one. Without a parent it gives its run back,
    # as rl_zoo3 takes Ctrl-C for the end of a training.
    if parent is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    elif signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _terminate_as_asked)


@contextmanager
def undisturbed() -> Iterator[None]:
    """
    Only note SIGTERM within a ``with`` block that must not be left halfway, such as one that takes runs or gives them back.

    The next call of :func:`end_if_asked` ends the process.
    """
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGTERM, _note) if is_main else None
    try:
        yield
    finally:
        if handler is not None:
            signal.signal(signal.SIGTERM, handler)


def _end(number: int) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)


def _is_ending() -> bool:
    return len(_noted) > 0 or StopSignals.is_asked()


def _note(number: int, frame: FrameType | None) -> None:
    if not _is_ending():
        _noted.append(number)


def _terminate(number: int, frame: FrameType | None) -> None:
    # A scheduler's signal reaches all processes of a job, and the parent's follows: the second one would interrupt the saving
    if not _is_ending():
        _noted.append(number)
        _end(number)


def _interrupt(number: int, frame: FrameType | None) -> None:
    # Not once only: Ctrl-C a second time kills the processes that the first one ends
    _noted.append(number)
    _end(number)


def _terminate_as_asked(number: int, frame: FrameType | None) -> None:
    # Ctrl-C a second time does not wait for the saving
    if _is_ending():
        _end(signal.SIGTERM)
    signal.raise_signal(signal.SIGTERM)
