# SPDX-License-Identifier: MIT
"""Data sets. Import the submodule you need, e.g. ``from ajna.data.pairs import PairsDataset``."""
