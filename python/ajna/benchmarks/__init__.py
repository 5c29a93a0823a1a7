# SPDX-License-Identifier: MIT
"""Comparisons that print a table: what `ajna bench` runs."""
