# SPDX-License-Identifier: MIT
"""Experiments that hold a claim against measurements: ``ajna study``."""
