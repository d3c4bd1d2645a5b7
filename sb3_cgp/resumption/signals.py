"""The signals that end a training after its state has been saved: SIGTERM, and Ctrl-C's SIGINT."""

import os
import signal
import threading
from types import FrameType
from typing import Any, ClassVar, NoReturn, Optional

MESSAGE = b"\nThe training saves its state and stops when this rollout is over. Press Ctrl-C again to stop at once.\n"


class StopSignals:
    """
    Note a signal that asks the process to end, so that a training can save its state before.

    SIGTERM's own handler is called when the training ends. A second signal has the effect that it has without this object. In
    a training within a callback of another one, only the object of the outer one has an effect.
    """

    # The one that has noted the last signal
    _last: ClassVar[Optional["StopSignals"]] = None

    def __init__(self) -> None:
        self.noted: int | None = None
        self._previous: dict[int, Any] = {}
        # The handler that the noted signal had
        self._noted_handler: Any = None
        self._process = 0

    def watch(self) -> None:
        """
        Handle the signals, until :meth:`restore`.

        It has no effect in another thread than the main one, where Python sets no handlers, on a signal that is ignored or
        that another such object handles, on SIGINT if it has another handler than Python's own, and after a noted signal.
        """
        if threading.current_thread() is not threading.main_thread() or StopSignals.is_asked():
            return
        self._process = os.getpid()
        for number in (signal.SIGTERM, signal.SIGINT):
            handler = signal.getsignal(number)
            is_watched = isinstance(getattr(handler, "__self__", None), StopSignals)
            may_be_replaced = number == signal.SIGTERM or handler is signal.default_int_handler
            # A handler that Python has not set (None) could not be restored
            if handler not in (None, signal.SIG_IGN) and not is_watched and may_be_replaced:
                self._previous[number] = signal.signal(number, self._note)

    def restore(self) -> None:
        """Restore the handlers that the signals had, but for those that others have set since."""
        for number, handler in self._previous.items():
            if signal.getsignal(number) == self._note:
                signal.signal(number, handler)
        self._previous = {}

    def release(self) -> None:
        """Restore the handlers, and forget the noted signal, at the end of the training."""
        self.restore()
        self.noted = self._noted_handler = None

    def pass_on(self) -> None:
        """Call the handler that a noted SIGTERM had, if Python has set one, at the end of the training."""
        if self.noted == signal.SIGTERM and callable(self._noted_handler):
            self.noted = None
            self._noted_handler(signal.SIGTERM, None)

    @classmethod
    def is_asked(cls) -> bool:
        """Return whether a training of this process, which has not ended yet, has noted a signal."""
        return cls._last is not None and cls._last.noted is not None and cls._last._process == os.getpid()

    def _note(self, number: int, frame: FrameType | None) -> None:
        handler = self._previous.get(number)
        self.restore()
        if os.getpid() != self._process:
            # This process was forked during the training, by a simulator for example: the signal has its usual effect
            os.kill(os.getpid(), number)
            return
        self.noted, self._noted_handler, StopSignals._last = number, handler, self
        if number == signal.SIGINT:
            # `print` in a handler may interrupt another `print`
            os.write(2, MESSAGE)


def end_training(number: int, reason: str) -> NoReturn:
    """
    End a training as a signal asks.

    :param number: the signal
    :param reason: the message of the ``KeyboardInterrupt``
    :raises KeyboardInterrupt: after SIGINT
    :raises SystemExit: after SIGTERM, with the status 143
    """
    if number == signal.SIGINT:
        raise KeyboardInterrupt(reason)
    raise SystemExit(128 + signal.SIGTERM)
