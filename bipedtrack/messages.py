"""How a command line refuses bad input."""

import sys
from typing import NoReturn


def fail(message: str) -> NoReturn:
    """Prints the message on stderr, each line under the program's name, and exits with status 2."""
    print(f"bipedtrack: {message}", file=sys.stderr)
    sys.exit(2)
