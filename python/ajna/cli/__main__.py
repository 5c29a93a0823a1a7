# SPDX-License-Identifier: MIT
import sys

from ajna.cli import main

sys.exit(main())
