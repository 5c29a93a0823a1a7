# SPDX-License-Identifier: MIT
"""Losses that teach a network its own uncertainty, as ordinary modules over the C++ implementation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from ajna import _core

_DEFAULTS = _core.LossConfig()

Term = str | Mapping[str, Any]


def _term_spec(role: str, term: Term) -> Any:
    """`"name"` or `{"name": ..., "params": {...}}` -> the C++ TermSpec."""
    if isinstance(term, str):
        return _core.TermSpec(term)
    if isinstance(term, _core.TermSpec):
        return term
    if not isinstance(term, Mapping):
        raise ValueError(f"loss term {role} = {term!r}: give a name, or a mapping with 'name' and 'params'")
    unknown = sorted(set(term) - {"name", "params"})
    if unknown or "name" not in term:
        what = f"has the unknown key '{unknown[0]}'" if unknown else "has no 'name'"
        raise ValueError(f"loss term {role} {what}: give a mapping with 'name' and, if needed, 'params'")
    return _core.TermSpec(term["name"], {key: float(value) for key, value in (term.get("params") or {}).items()})


class UncertaintyLoss(nn.Module):
    """The generalized heteroscedastic loss, paper Eqs. 11 and 12: E[h(a) f(prediction, target)] + lam E[g(a)].

    With ``a = parametrization(raw)``; the defaults (read from the C++ ``LossConfig``) are the paper's Eq. 1. It works
    for any network that predicts a value and a raw uncertainty of the same shape.

    Args:
        f: distance between prediction and target, ``"l1"``, ``"squared_error"`` or ``"charbonnier"``.
        h: attenuation of f, ``"inv_softplus"``, ``"inv"`` or ``"inv_square"``.
        g: penalty on the uncertainty, ``"softplus"``, ``"log"`` or ``"log_square"``.
        lam: weight of g, finite and above 0.
        parametrization: raw -> a, ``"none"``, ``"softplus"`` or ``"exp"``.

    A term is a name, or ``{"name": ..., "params": {...}}``; :func:`term_names` lists the names.

    Raises:
        ValueError: for an unknown term or parameter (with the nearest known one) or an unusable ``lam``.
    """

    def __init__(
        self,
        f: Term = _DEFAULTS.f.name,
        h: Term = _DEFAULTS.h.name,
        g: Term = _DEFAULTS.g.name,
        lam: float = _DEFAULTS.lam,
        parametrization: Term = _DEFAULTS.parametrization.name,
    ) -> None:
        super().__init__()
        config = _core.LossConfig()
        config.f, config.h, config.g = _term_spec("f", f), _term_spec("h", h), _term_spec("g", g)
        config.lam = lam
        config.parametrization = _term_spec("parametrization", parametrization)
        self._core = _core.UncertaintyLoss(config)

    def forward(
        self,
        prediction: Tensor,
        raw: Tensor,
        target: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        reduction: str = "mean",
    ) -> Tensor:
        """The loss; all arithmetic in float32 or wider.

        Args:
            prediction, target: [N, C, ...], equal shapes and units.
            raw: the network's raw uncertainty, the prediction's shape or one channel.
            mask: bool or {0, 1}, [N, 1, H, W], [N, H, W] or the prediction's shape. Where it is false nothing is
                read, forward or backward: NaN and Inf may stand there.
            weight: >= 0, shaped as ``mask`` may be.
            reduction: ``"mean"`` (over weighted valid elements; 0 without any), ``"sum"`` or ``"none"``.

        Raises:
            ValueError: where shapes do not fit.
        """
        return self._core(prediction, raw, target, mask, weight, reduction)

    def uncertainty(self, raw: Tensor) -> Tensor:
        """g(a(raw)), the paper's uncertainty: same shape as ``raw``, float32 or wider."""
        return self._core.uncertainty(raw)

    def expected_error(self, raw: Tensor) -> Tensor:
        """kappa(raw) = -lam g'/h': the mean f at which this ``raw`` is optimal, in the unit of f; same shape."""
        return self._core.expected_error(raw)

    @property
    def config(self) -> Any:
        """The C++ ``LossConfig`` (a copy)."""
        return self._core.config

    def describe(self) -> str:
        """One line that names all terms, as stored in checkpoints."""
        return repr(self._core)[len("UncertaintyLoss(") : -1]

    def extra_repr(self) -> str:
        return self.describe()

    def __getstate__(self) -> dict[str, Any]:
        config = self.config
        terms = {
            role: {"name": spec.name, "params": dict(spec.params)}
            for role, spec in (("f", config.f), ("h", config.h), ("g", config.g), ("p", config.parametrization))
        }
        attributes = {name: value for name, value in self.__dict__.items() if name != "_core"}
        return {"terms": terms, "lam": config.lam, "attributes": attributes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        terms = state["terms"]
        fresh = type(self)(terms["f"], terms["h"], terms["g"], state["lam"], terms["p"])
        self.__dict__.update({**fresh.__dict__, **state["attributes"]})


def term_names() -> dict[str, list[str]]:
    """Known names by role: ``f``, ``h``, ``g`` and ``parametrization``."""
    return _core.loss_term_names()
