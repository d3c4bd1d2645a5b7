"""The end of a command after an error that the user can mend: a message, and no traceback."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from benchmark.sweeps.storages import StorageError


@contextmanager
def errors_in_words(*faults: type[Exception]) -> Iterator[None]:
    """
    End the process with a message after an error of the user's, of the storage or of a file, and silently after Ctrl-C.

    :param faults: the errors of the user's
    :raises SystemExit: after such an error; any other error is raised
    """
    try:
        yield
    except faults as error:
        sys.exit(f"Error: {error}")
    except StorageError as error:
        sys.exit(f"Error: the storage does not answer: {error}. When it does, the same command continues.")
    except OSError as error:
        sys.exit(f"Error: {error}")
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
