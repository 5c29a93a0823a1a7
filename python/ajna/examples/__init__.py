# SPDX-License-Identifier: MIT
"""The uncertainty loss on other networks and quantities, each trained on generated scenes in about a minute.

``python -m ajna.examples.depth``, ``.disparity``, ``.normals`` and ``.segmentation``: a small network of plain PyTorch
(:mod:`ajna.examples.unet`), a loss of :mod:`ajna.losses`, and a check that the uncertainty is high where it should be.
"""
