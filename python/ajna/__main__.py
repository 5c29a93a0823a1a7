# SPDX-License-Identifier: MIT
"""``python -m ajna``: the command line, where the script `ajna` is not on the path."""

import sys

from ajna.cli import main

if __name__ == "__main__":
    sys.exit(main())
