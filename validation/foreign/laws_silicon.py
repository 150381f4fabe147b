"""Laws of the edges' answer to charge: nonlinear, chromatic, anisotropic, long-range, by voltage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from validation.foreign.collection import Term
from validation.foreign.device import (
    REFERENCE,
    absorption_length,
    edge_shifts,
)
from validation.foreign.law import Law, after, law


def either_sign(rng: np.random.Generator) -> dict[str, Any]:
    """A sign for the amplitude."""
    return {"sign": float(rng.choice([-1.0, 1.0]))}


def _scaled(terms: list[Term], x: Any, y: Any) -> list[Term]:
    return [Term(t.kx * x, t.ky * y, t.source) for t in terms]


def _radius(half: int, axis: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance of right (x) or upper (y) edges from the charge, and its components [pixel]."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    if axis == "x":
        x += 0.5
    else:
        y += 0.5
    return np.hypot(x, y), x, y


# -------------------------------------------------------------------- nonlinear in charge
@law(
    "bf_nonlinear",
    "packet_height",
    amplitude="b",
    start=8e-06,
    limits=(2e-08, 1.2e-05),
    source="Astier et al. 2019 (A&A 629, A36), section 2: a_ij (1 + b mu); here k "
    "Q (1 + b Q/2)",
)
class PacketHeight(Law):
    """Every shift grows with its charge as k Q (1 + b Q / 2)."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        b = np.float32(self.values["b"] / 2)
        if not b:
            return terms
        return [Term(t.kx, t.ky, after(t, lambda q: q * (1 + b * q))) for t in terms]


@law(
    "bf_nonlinear",
    "two_axes",
    amplitude="b",
    start=7e-06,
    limits=(2e-08, 1.2e-05),
    source="Broughton et al. 2024 (PASP 136, 045003): higher orders evolve anisotropically",
)
class TwoAxes(Law):
    """The two axes have b (1 - split) and b (1 + split)."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "split": round(rng.uniform(0.4, 1.0), 3)}

    def terms(self, terms, exposure):
        b, split = self.values["b"] / 2, self.values["split"]
        bx, by = np.float32(b * (1 - split)), np.float32(b * (1 + split))
        if not b:
            return terms
        out = []
        for t in terms:
            out.append(Term(t.kx, 0 * t.ky, after(t, lambda q: q * (1 + bx * q))))
            out.append(Term(0 * t.kx, t.ky, after(t, lambda q: q * (1 + by * q))))
        return out


@law(
    "bf_nonlinear",
    "own_edges",
    amplitude="b",
    start=9e-06,
    limits=(2e-08, 1.2e-05),
    source="Astier & Regnault 2023 (A&A 670, A118): b_ij differ between lags; the "
    "nearest edges feel the packet's height most",
)
class OwnEdges(Law):
    """Only the pixel's own four edges answer as k Q (1 + b Q / 2); farther ones stay linear."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        b = np.float32(self.values["b"] / 2)
        if not b:
            return terms
        out = []
        for t in terms:
            m = t.kx.shape[0] // 2
            kx, ky = np.zeros_like(t.kx), np.zeros_like(t.ky)
            kx[m, m - 1 : m + 1] = t.kx[m, m - 1 : m + 1]
            ky[m - 1 : m + 1, m] = t.ky[m - 1 : m + 1, m]
            out += [Term(t.kx, t.ky, t.source), Term(kx, ky, after(t, lambda q: b * q * q))]
        return out


@law(
    "bf_nonlinear",
    "saturating",
    amplitude="b",
    start=9e-06,
    limits=(2e-08, 2e-05),
    source="Lage et al. 2017 (JINST 12, C03091) and Rasmussen et al. 2016: the "
    "packet widens and its field saturates; here k Q / (1 - b Q/2), b < 0",
)
class Saturating(Law):
    """Shifts saturate as k Q / (1 - b Q / 2), b < 0."""

    draw = classmethod(lambda cls, rng, setting: {"sign": -1.0})

    def terms(self, terms, exposure):
        b = np.float32(self.values["b"] / 2)
        if not b:
            return terms
        return [
            Term(t.kx, t.ky, after(t, lambda q: q / (1 - b * np.maximum(q, 0))))
            for t in terms
        ]


# -------------------------------------------------------------------- wavelength, axes, distance
@law(
    "bf_chromatic",
    "linear",
    amplitude="kappa",
    start=0.3,
    limits=(0.0001, 0.6),
    needs=("wavelengths",),
    source="Astier et al. 2019 and Lage et al. 2017 report shifts that fall by a "
    "few percent to the red; here linear in wavelength",
)
class ChromaticLinear(Law):
    """Shifts change by kappa for each 330 nm from 620 nm."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        f = 1 + self.values["kappa"] * (exposure.wavelength - 620.0) / 330.0
        return _scaled(terms, f, f)


@law(
    "bf_chromatic",
    "absorption",
    amplitude="scale",
    start=3,
    limits=(0.001, 5.0),
    needs=("wavelengths",),
    source="Rajkanan, Singh & Shewchun 1979 (Solid-State Electron. 22, 793): "
    "absorption depends on temperature; conversions lie deeper than the "
    "card says",
)
class ChromaticAbsorption(Law):
    """Absorption lengths are longer than the card's by (1 + scale)."""

    def absorption(self, length, exposure):
        return length * (1 + self.values["scale"])

    def settle(self):
        if self.setting is None:
            return
        d, length = self.setting.nominal, absorption_length(950)
        k = [abs(edge_shifts(d, 950, absorption=length * s)[1]).max()
             for s in (1.0, 1 + self.values.get("scale", 0.0))]  # fmt: skip
        self.values["kappa"] = float(k[1] / k[0] - 1)


@law(
    "bf_chromatic",
    "window",
    amplitude="kappa",
    start=0.3,
    limits=(0.0001, 0.6),
    needs=("wavelengths",),
    source="Rasmussen et al. 2014 (JINST 9, C04027): near the back window the "
    "drift field is weaker; only light absorbed there, the blue, sees "
    "larger shifts",
)
class ChromaticWindow(Law):
    """Shifts change by kappa (1 - exp(-L0/L)), L the absorption length, L0 that at 620 nm."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        near = -np.expm1(-absorption_length(620) / absorption_length(exposure.wavelength))
        f = 1 + self.values["kappa"] * (near / -np.expm1(-1.0) - 1)
        return _scaled(terms, f, f)


@law(
    "bf_anisotropy",
    "uniform",
    amplitude="eps",
    start=0.4,
    limits=(0.0002, 0.8),
    source="Antilogus et al. 2014 (JINST 9, C03048); Guyonnet et al. 2015 (A&A "
    "575, A41): coefficients of the two axes are independent",
)
class AnisotropyUniform(Law):
    """kx (1 - eps/2), ky (1 + eps/2) at all distances."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        eps = self.values["eps"]
        return _scaled(terms, 1 - eps / 2, 1 + eps / 2)


@law(
    "bf_anisotropy",
    "near",
    amplitude="eps",
    start=0.5,
    limits=(0.0002, 0.8),
    source="Astier & Regnault 2023: barriers of the two axes seal at different "
    "heights, which only near edges feel; here eps exp(-(r - 1/2)/length)",
)
class AnisotropyNear(Law):
    """The split of the axes falls with the distance r of the edge as exp(-(r - 1/2)/length)."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "length": round(rng.uniform(0.5, 2.0), 3)}

    def terms(self, terms, exposure):
        eps, length = self.values["eps"], self.values["length"]
        out = []
        for t in terms:
            half = t.kx.shape[0] // 2
            fx = eps / 2 * np.exp(-(_radius(half, "x")[0] - 0.5) / length)
            fy = eps / 2 * np.exp(-(_radius(half, "y")[0] - 0.5) / length)
            out.append(Term(t.kx * (1 - fx), t.ky * (1 + fy), t.source))
        return out


class _Tail(Law):
    """Edges move towards the charge so that areas at distance r grow by a tail a(r)."""

    half = 24

    draw = classmethod(lambda cls, rng, setting: cls.shape(rng))

    def inward(self, r):
        """Shift towards the charge at distance r [pixel per e-]."""
        raise NotImplementedError

    def terms(self, terms, exposure):
        half = min(self.half, self.setting.layout.pixels // 4)
        rx, x, _ = _radius(half, "x")
        ry, _, y = _radius(half, "y")
        inside_x, inside_y = rx < half, ry < half
        kx = -self.inward(rx) * x / rx * inside_x
        ky = -self.inward(ry) * y / ry * inside_y
        if not self.values["amp"]:
            return terms
        return [*terms, Term(kx, ky)]


@law(
    "bf_long_range",
    "inverse_square",
    amplitude="amp",
    start=3.6e-08,
    limits=(1e-11, 2e-07),
    source="Rasmussen et al. 2016; Astier et al. 2019, fig. 10: decay slower than "
    "the image charges'; area change amp / r^2 within range",
)
class InverseSquare(_Tail):
    """Area changes amp / r^2 up to the range, from r d = amp ln(range / r)."""

    @classmethod
    def shape(cls, rng):
        return {"range": float(round(rng.uniform(14, 24), 2))}

    def inward(self, r):
        return self.values["amp"] * np.log(np.maximum(self.values["range"] / r, 1.0)) / r


@law(
    "bf_long_range",
    "exponential",
    amplitude="amp",
    start=3.6e-09,
    limits=(1e-12, 5e-08),
    source="Holland et al. 2014 (JINST 9, C03057): field of the stored charge "
    "through an undepleted layer; area change amp exp(-r/length)",
)
class ExponentialTail(_Tail):
    """Area changes amp exp(-r / length), from r d = amp length (r + length) exp(-r / length)."""

    @classmethod
    def shape(cls, rng):
        return {"length": float(round(rng.uniform(2.0, 6.0), 3))}

    def inward(self, r):
        scale = self.values["length"]
        return self.values["amp"] * scale * (1 + scale / r) * np.exp(-r / scale)


@law(
    "voltage_dependence",
    "linear",
    amplitude="delta",
    start=0.2,
    limits=(0.0002, 0.6),
    needs=("voltages",),
    source="Guyonnet et al. 2015 and Lage et al. 2017: strength against back bias;"
    " here linear, delta for 20 V towards less bias",
)
class VoltageLinear(Law):
    """Shifts change by delta for each 20 V from the first back bias."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        f = 1 + self.values["delta"] * (exposure.back_bias - REFERENCE[1]) / 20.0
        return _scaled(terms, f, f)


@law(
    "voltage_dependence",
    "power",
    amplitude="delta",
    start=0.2,
    limits=(0.0002, 0.6),
    needs=("voltages",),
    source="Holland et al. 2014: drift time as a power of the voltage; here V^p "
    "with the change delta at +20 V",
)
class VoltagePower(Law):
    """Shifts carry a further factor (V / V0)^p; delta is its value at V0 + 20 V, less one."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def settle(self):
        delta = self.values.get("delta", 0.0)
        self.values["exponent"] = float(np.log1p(delta) / np.log(40.0 / 60.0))

    def terms(self, terms, exposure):
        f = (exposure.back_bias / REFERENCE[1]) ** self.values["exponent"]
        return _scaled(terms, f, f)


@law(
    "voltage_dependence",
    "drop",
    amplitude="frac",
    start=0.4,
    limits=(0.0005, 0.9),
    needs=("voltages",),
    source="Juramy et al. 2020 (arXiv 2002.09439): part of a change of the "
    "substrate's voltage does not reach the sensor",
)
class VoltageDrop(Law):
    """Only (1 - frac) of a change of back bias reaches the silicon."""

    def device(self, device, exposure):
        change = exposure.back_bias - REFERENCE[1]
        return replace(device, vbb=device.vbb - self.values["frac"] * change)

    def settle(self):
        if self.setting is None:
            return
        d, frac = self.setting.nominal, self.values.get("frac", 0.0)
        k = [
            abs(edge_shifts(replace(d, vbb=v), 620)[1]).max()
            for v in (-40, -40 - 20 * frac)
        ]
        self.values["delta"] = float(k[1] / k[0] - 1)
