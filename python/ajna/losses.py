# SPDX-License-Identifier: MIT
"""Losses that teach a network its own uncertainty, as ordinary modules over the C++ implementation."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from ajna import _core

_DEFAULTS = _core.LossConfig()
_ROLES = ("f", "h", "g", "parametrization")

#: A registered name, an expression, a callable, or {"name": name or expression, "params": {...}}.
Term = str | Mapping[str, Any] | Callable[..., Tensor]
Preset = _core.LossPreset
AdmissibilityReport = _core.AdmissibilityReport
Likelihood = _core.Likelihood


class AdmissibilityWarning(UserWarning):
    """A loss whose raw output, once trained, is no measure of the expected error."""


def _own(role: str, label: str, function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def checked(*arguments: Tensor) -> Tensor:
        result = function(*arguments)
        if not isinstance(result, Tensor):
            raise ValueError(f"loss term {role} = '{label}' returns {type(result).__name__}: return a torch.Tensor")
        return result

    return checked


def _term_spec(role: str, term: Term | _core.TermSpec) -> _core.TermSpec:
    """Any form of a term -> the C++ TermSpec."""
    if isinstance(term, str):
        return _core.TermSpec(term)
    if isinstance(term, _core.TermSpec):
        return term
    if callable(term):
        label = getattr(term, "__name__", type(term).__name__)
        function = _own(role, label, term)
        if role == "f":
            return _core.TermSpec(label, error_function=function)
        return _core.TermSpec(label, function=function)
    if not isinstance(term, Mapping):
        raise ValueError(
            f"loss term {role} = {term!r}: give a name, an expression, a callable, or a mapping with 'name'"
        )
    unknown = sorted(set(term) - {"name", "params"})
    if unknown or "name" not in term:
        what = f"has the unknown key '{unknown[0]}'" if unknown else "has no 'name'"
        raise ValueError(f"loss term {role} {what}: give a mapping with 'name' and, if needed, 'params'")
    params = {}
    for key, value in (term.get("params") or {}).items():
        try:
            params[key] = float(value)
        except (TypeError, ValueError):
            raise ValueError(f"parameter '{key}' of loss term {role} is {value!r}: give a number") from None
    return _core.TermSpec(term["name"], params)


def _portable(role: str, spec: _core.TermSpec, given: Any) -> Any:
    """What pickles in place of a TermSpec: the callable itself, or name and parameters."""
    if spec.is_function:
        if isinstance(given, _core.TermSpec):
            raise ValueError(f"loss term {role} = '{spec.name}' is a C++ function and cannot be copied or pickled")
        return given
    return {"name": spec.name, "params": dict(spec.params)}


class UncertaintyLoss(nn.Module):
    """The generalized heteroscedastic loss, paper Eqs. 11 and 12: E[h(a) f(prediction, target)] + lam E[g(a)].

    With ``a = parametrization(raw)``; the defaults (read from the C++ ``LossConfig``) are the paper's Eq. 1. It works
    for any network that predicts a value and a raw uncertainty.

    Args:
        f: distance between prediction and target; element-wise, or over the channel axis with one channel out.
        h: attenuation of f, positive and falling with raw.
        g: penalty on the uncertainty, rising with raw.
        lam: weight of g, finite and above 0.
        parametrization: raw -> a.
        strict: refuse an inadmissible choice (see :meth:`check`) instead of warning.

    A term is a registered name (:func:`term_names`), an expression such as ``"1 / log(1 + exp(a + 1e-3))"`` (in ``a``;
    f in ``prediction`` and ``target``, the parametrization in ``raw``; functions: :func:`expression_functions`), a
    callable on tensors, or ``{"name": name or expression, "params": {...}}``; parameters are an expression's constants.

    Raises:
        ValueError: for an unknown term or parameter (with the nearest known one), an expression that does not parse
            or is not finite on its domain, an unusable ``lam``, and, if ``strict``, an inadmissible choice.

    Warns:
        AdmissibilityWarning: for an inadmissible choice.
    """

    def __init__(
        self,
        f: Term = _DEFAULTS.f.name,
        h: Term = _DEFAULTS.h.name,
        g: Term = _DEFAULTS.g.name,
        lam: float = _DEFAULTS.lam,
        parametrization: Term = _DEFAULTS.parametrization.name,
        strict: bool = False,
    ) -> None:
        super().__init__()
        given = dict(zip(_ROLES, (f, h, g, parametrization), strict=True))
        config = _core.LossConfig()
        config.f, config.h, config.g = _term_spec("f", f), _term_spec("h", h), _term_spec("g", g)
        config.lam = float(lam)
        config.parametrization = _term_spec("parametrization", parametrization)
        self._given = given
        self._core = _core.UncertaintyLoss(config)
        report = self.check()
        if not report.admissible:
            message = f"loss {self.describe()} is inadmissible: {report.reason}"
            if strict:
                raise ValueError(message)
            warnings.warn(message, AdmissibilityWarning, stacklevel=2)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], strict: bool = False) -> UncertaintyLoss:
        """From a mapping as a YAML file holds it: ``f``, ``h``, ``g``, ``lam``, ``parametrization``, or ``preset`` with
        any of these over it.

        Raises:
            ValueError: for an unknown key (with the nearest known one) and as the constructor.
        """
        known = ["f", "h", "g", "lam", "parametrization", "preset"]
        for key in config:
            if key not in known:
                near = _core.nearest_name(str(key), known)
                hint = f", did you mean '{near}'?" if near else ""
                raise ValueError(f"unknown loss option '{key}'{hint} Known: {', '.join(known)}")
        options: dict[str, Any] = {}
        if "preset" in config:
            base = _core.loss_preset(config["preset"]).config
            options = {role: getattr(base, role) for role in (*_ROLES, "lam")}
        options.update({key: value for key, value in config.items() if key != "preset"})
        return cls(**options, strict=strict)

    def forward(
        self,
        prediction: Tensor | Sequence[Tensor],
        raw: Tensor | Sequence[Tensor],
        target: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        reduction: str = "mean",
        scale_weights: Sequence[float] | None = None,
    ) -> Tensor:
        """The loss; all arithmetic in float32 or wider.

        Args:
            prediction, target: [N, C, ...], equal shapes and units; ``cross_entropy`` takes logits, and as target class
                probabilities or class indices (integer, [N, ...] or [N, 1, ...]).
            raw: the network's raw uncertainty, the shape of f's value (the prediction's; one channel for terms over the
                channel axis) or one channel shared over the axes.
            mask: bool or {0, 1}, [N, 1, H, W], [N, H, W] or the prediction's shape. Where it is false nothing is
                read, forward or backward: NaN and Inf may stand there.
            weight: >= 0, shaped as ``mask`` may be.
            reduction: ``"mean"`` (over weighted valid elements; 0 without any), ``"sum"`` or ``"none"``.
            scale_weights: for lists of predictions and raw maps [N, C, h, w], the scales of a multi-scale network: the
                losses' weights, by default 1 each. The target is averaged to each scale, its unit unchanged.

        Raises:
            ValueError: where shapes do not fit.
        """
        if isinstance(prediction, Tensor) and isinstance(raw, Tensor):
            if scale_weights is not None:
                raise ValueError("scale_weights need a list of predictions and one of raw: give both as lists")
            return self._core(prediction, raw, target, mask, weight, reduction)
        if isinstance(prediction, Tensor) or isinstance(raw, Tensor):
            raise ValueError("one of prediction and raw is a list, the other a tensor: give both as lists")
        weights = list(scale_weights or ())
        return self._core.multi_scale(list(prediction), list(raw), target, weights, mask, weight, reduction)

    def error(self, prediction: Tensor, target: Tensor) -> Tensor:
        """f(prediction, target) alone: the prediction's shape, or one channel for terms over the channel axis.

        Raises:
            ValueError: where shapes do not fit.
        """
        config = self.config
        # With h = 1, g = a and raw = 0 the loss is f itself.
        config.h, config.g, config.lam = _core.TermSpec("one"), _core.TermSpec("identity"), 1.0
        config.parametrization = _core.TermSpec("none")
        raw = prediction.new_zeros([1] * prediction.dim())
        return _core.UncertaintyLoss(config)(prediction, raw, target, None, None, "none")

    def uncertainty(self, raw: Tensor) -> Tensor:
        """g(a(raw)), the paper's uncertainty: same shape as ``raw``, float32 or wider."""
        return self._core.uncertainty(raw)

    def attenuation(self, raw: Tensor) -> Tensor:
        """h(a(raw)), the factor of f: same shape as ``raw``, float32 or wider."""
        return self._core.attenuation(raw)

    def expected_error(self, raw: Tensor) -> Tensor:
        """kappa(raw) = -lam g'/h': the mean f at which this ``raw`` is optimal, in the unit of f; same shape."""
        return self._core.expected_error(raw)

    def curves(self, raw: Tensor) -> dict[str, Tensor]:
        """``raw``, ``h``, ``g``, ``h_slope``, ``g_slope`` (in raw) and ``kappa`` as float64, for plots."""
        return self._core.curves(raw)

    def check(self, raw_min: float | None = None, raw_max: float | None = None) -> AdmissibilityReport:
        """Whether raw measures the expected error over a domain of raw (by default -10 to 64).

        The report has ``admissible``, ``fails_at`` (the lowest failing raw), ``reason``, and the expected errors at the
        domain's ends, ``error_min`` and ``error_max``; it is true where the loss is admissible.
        """
        ends = {"raw_min": raw_min, "raw_max": raw_max}
        return self._core.check(**{name: value for name, value in ends.items() if value is not None})

    def likelihood(self, channels: int = 1) -> Likelihood:
        """The error distribution whose negative log-likelihood this loss is, up to a factor and a constant.

        Args:
            channels: dimensions that one value of f spans (for ``l2`` and ``squared_l2``).

        Raises:
            ValueError: where there is none.
        """
        return _core.Likelihood.require(self._core, channels)

    def is_normalised(self, channels: int = 1) -> bool:
        """Whether exp(-loss), times a constant, is a normalised density of the target."""
        found = _core.Likelihood.of(self._core, channels)
        return found is not None and found.is_normalised

    def nll(self, prediction: Tensor, raw: Tensor, target: Tensor) -> Tensor:
        """-log p(target | prediction, raw) in nats, the shape of f's value; ValueError without a likelihood."""
        return self.likelihood(self._channels(prediction)).nll(prediction, raw, target)

    def crps(self, prediction: Tensor, raw: Tensor, target: Tensor) -> Tensor:
        """Continuous ranked probability score per component, the prediction's shape and unit.

        Raises:
            ValueError: for losses that are neither a Laplace nor a Gaussian likelihood.
        """
        return self.likelihood(self._channels(prediction)).crps(prediction, raw, target)

    def _channels(self, prediction: Tensor) -> int:
        """What one value of f spans."""
        return prediction.shape[1] if self.config.f.name in ("l2", "squared_l2") and prediction.dim() > 1 else 1

    def cdf(self, error: Tensor, raw: Tensor, channels: int = 1) -> Tensor:
        """P(target - prediction <= error) per component, also for ``squared_l2``.

        For ``angular`` P(angle <= error), radians; for ``l2`` over several channels P(length <= error), the length of
        target - prediction over them.
        """
        return self.likelihood(channels).cdf(error, raw)

    def quantile(self, p: Tensor, raw: Tensor, channels: int = 1) -> Tensor:
        """The error x with ``cdf(x, raw) = p``, 0 < p < 1; ``p`` broadcasts with ``raw``."""
        return self.likelihood(channels).quantile(p, raw)

    def interval(self, p: float, raw: Tensor, channels: int = 1) -> tuple[Tensor, Tensor]:
        """Low and high end of the central interval of target - prediction with probability ``p``, shapes of ``raw``.

        What the ends bound is what :meth:`cdf` is of; for an angle or a length the low end is 0.
        """
        return self.likelihood(channels).interval(p, raw)

    def sample(self, raw: Tensor, channels: int = 1) -> Tensor:
        """One error per element of ``raw``, from torch's default generator."""
        return self.likelihood(channels).sample(raw)

    @property
    def config(self) -> _core.LossConfig:
        """The C++ ``LossConfig`` (a copy)."""
        return self._core.config

    def describe(self) -> str:
        """One line that names all terms, as stored in checkpoints."""
        return self._core.describe()

    def extra_repr(self) -> str:
        return self.describe()

    def __getstate__(self) -> dict[str, Any]:
        config = self.config
        terms = {role: _portable(role, getattr(config, role), self._given[role]) for role in _ROLES}
        attributes = {name: value for name, value in self.__dict__.items() if name not in ("_core", "_given")}
        return {"terms": terms, "lam": config.lam, "attributes": attributes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AdmissibilityWarning)  # the original has warned
            fresh = type(self)(**state["terms"], lam=state["lam"])
        self.__dict__.update({**fresh.__dict__, **state["attributes"]})


def term_names() -> dict[str, list[str]]:
    """Known names by role: ``f``, ``h``, ``g`` and ``parametrization``."""
    return _core.loss_term_names()


def expression_functions() -> list[str]:
    """The functions that an expression may call."""
    return _core.loss_expression_functions()


def presets() -> list[Preset]:
    """The published losses: Table 3 in its order, the paper's own, and the rows as printed that cannot be meant so."""
    return _core.loss_presets()


def preset(name: str, strict: bool = False) -> UncertaintyLoss:
    """The published loss ``name``, e.g. ``"kendall2017"``; names ending in ``_printed`` warn, being inadmissible.

    Raises:
        ValueError: for an unknown name (with the nearest known one) and, if ``strict``, for an inadmissible one.
    """
    return UncertaintyLoss.from_config({"preset": name}, strict=strict)
