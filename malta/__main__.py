"""`python -m malta` is the program `malta`."""

import os
import signal
import sys
from contextlib import suppress

INTERRUPTED = 130  # exit code


def main() -> None:
    """Run the program; Ctrl-C before it begins or after it has ended makes no traceback.

    An interrupted process ends at once: Python would end it with the signal where some library was just being read.
    """
    try:
        from malta.cli.main import main as run

        run()
    except KeyboardInterrupt:
        _leave()
    except (ImportError, RuntimeError, SystemError) as error:
        # what C code makes of Ctrl-C, while modules are read
        if isinstance(error.__cause__, KeyboardInterrupt):
            _leave()
        raise
    except SystemExit as ended:
        if ended.code == INTERRUPTED:
            _leave()
        raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _leave() -> None:
    """End the process with the exit code of an interruption."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
