# SPDX-License-Identifier: MIT
"""Training on synthetic scenes and data sets: Lightning module, streams, run folder, command (needs ``lightning``)."""

from ajna.training.data import SyntheticData
from ajna.training.datasets import DatasetData
from ajna.training.module import FlowModule
from ajna.training.options import LossOptions, NetOptions, OptimOptions, Stage, ValidationOptions
from ajna.training.stream import SceneStream
from ajna.training.throughput import throughput

__all__ = [
    "DatasetData",
    "FlowModule",
    "LossOptions",
    "NetOptions",
    "OptimOptions",
    "SceneStream",
    "Stage",
    "SyntheticData",
    "ValidationOptions",
    "throughput",
]
