"""What a command line says, and what it does not."""

import contextlib
import io
import sys
from typing import NoReturn


class Refusal(Exception):
    """What was asked for cannot be; the message says what is wrong and what was wanted."""


def quiet_imports() -> contextlib.redirect_stdout[io.StringIO]:
    """A context for imports: mjx prints in its first one that its optional warp is missing."""
    return contextlib.redirect_stdout(io.StringIO())


def fail(message: str) -> NoReturn:
    """Prints the message on stderr, each line under the program's name, and exits with status 2."""
    for line in message.splitlines() or [""]:
        print(f"bipedtrack: {line}", file=sys.stderr)
    sys.exit(2)
