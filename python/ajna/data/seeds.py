# SPDX-License-Identifier: MIT
"""Seeds that follow from a position, never from a counter that a restart would reset."""

from __future__ import annotations

import hashlib


def derive_seed(*parts: int | str) -> int:
    """A 62-bit seed from ``parts``: equal parts give equal seeds; other parts give unrelated ones."""
    text = "/".join(str(part) for part in parts)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big") >> 2
