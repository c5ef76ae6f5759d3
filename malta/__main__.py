"""`python -m malta` is the program `malta`."""

import os
import shutil
import signal
import sys
from contextlib import suppress
from pathlib import Path

INTERRUPT_EXIT_CODE = 130  # exit code
HELP = Path(__file__).parent / "cli" / "help.txt"  # of `malta --help --help`, which makes it anew
COLUMNS = 80  # from which it is the same on every terminal


def main() -> None:
    """Run the program; Ctrl-C before it begins or after it has ended makes no traceback.

    An interrupted process ends at once: Python would end it with the signal where some library was just being read.
    """
    try:
        if sys.argv[1:] == ["--help"] and shutil.get_terminal_size().columns >= COLUMNS and _print_help():
            return
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
        if ended.code == INTERRUPT_EXIT_CODE:
            _leave()
        raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _print_help() -> bool:
    """Print the help from its file: the libraries that make it take a tenth of a second. Returns whether it could."""
    try:
        sys.stdout.write(HELP.read_text(encoding="ascii"))
        sys.stdout.flush()
    except (AttributeError, OSError, ValueError):  # the program itself says what is wrong with its output
        return False
    return True


def _leave() -> None:
    """End the process with the exit code of an interruption."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(INTERRUPT_EXIT_CODE)


if __name__ == "__main__":
    main()
