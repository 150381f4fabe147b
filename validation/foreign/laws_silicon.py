"""Laws of collection: how charge moves edges, how much of the light is collected, diffusion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from validation.foreign.collection import Image, Term, divergence
from validation.foreign.device import REFERENCE, SPREAD, Device, absorption_length, edge_shifts
from validation.foreign.law import Law, law

BACK_BIAS_ERROR = 1.0
"""Sigma of a back bias about its card [V]; chosen, as cards state none."""


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
@law("bf_nonlinear", "packet_height", amplitude="b", start=4e-6, limits=(2e-8, 1.2e-5),
     source="Astier et al. 2019 (A&A 629, A36), section 2: a_ij (1 + b mu); here k Q (1 + b Q/2)")  # fmt: skip
class PacketHeight(Law):
    """Every shift grows with its charge as k Q (1 + b Q / 2)."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        b = np.float32(self.values["b"] / 2)
        if not b:
            return terms
        return [Term(t.kx, t.ky, lambda q: q * (1 + b * q)) for t in terms]


@law("bf_nonlinear", "two_axes", amplitude="b", start=5e-6, limits=(2e-8, 1.2e-5),
     source="Broughton et al. 2024 (PASP 136, 045003): higher orders evolve anisotropically")  # fmt: skip
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
            out.append(Term(t.kx, 0 * t.ky, lambda q: q * (1 + bx * q)))
            out.append(Term(0 * t.kx, t.ky, lambda q: q * (1 + by * q)))
        return out


@law("bf_nonlinear", "own_edges", amplitude="b", start=5e-6, limits=(2e-8, 1.2e-5),
     source="Astier & Regnault 2023 (A&A 670, A118): b_ij differ between lags; the nearest edges "
     "feel the packet's height most")  # fmt: skip
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
            out += [Term(t.kx, t.ky, t.source), Term(kx, ky, lambda q: b * q * q)]
        return out


@law("bf_nonlinear", "saturating", amplitude="b", start=5e-6, limits=(2e-8, 2e-5),
     source="Lage et al. 2017 (JINST 12, C03091) and Rasmussen et al. 2016: the packet widens and "
     "its field saturates; here k Q / (1 - b Q/2), b < 0")  # fmt: skip
class Saturating(Law):
    """Shifts saturate as k Q / (1 + |b| Q / 2)."""

    draw = classmethod(lambda cls, rng, setting: {"sign": -1.0})

    def terms(self, terms, exposure):
        b = np.float32(self.values["b"] / 2)
        if not b:
            return terms
        return [Term(t.kx, t.ky, lambda q: q / (1 - b * np.maximum(q, 0))) for t in terms]


# -------------------------------------------------------------------- wavelength, axes, distance
@law("bf_chromatic", "linear", amplitude="kappa", start=0.04, limits=(1e-4, 0.6),
     needs=("wavelengths",), source="Astier et al. 2019 and Lage et al. 2017 report shifts that "
     "fall by a few percent to the red; here linear in wavelength")  # fmt: skip
class ChromaticLinear(Law):
    """Shifts change by kappa for each 330 nm from 620 nm."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        f = 1 + self.values["kappa"] * (exposure.wavelength - 620.0) / 330.0
        return _scaled(terms, f, f)


@law("bf_chromatic", "absorption", amplitude="scale", start=0.5, limits=(1e-3, 5.0),
     needs=("wavelengths",), source="Rajkanan, Singh & Shewchun 1979 (Solid-State Electron. 22, "
     "793): absorption depends on temperature; conversions lie deeper than the card says")  # fmt: skip
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


@law("bf_chromatic", "window", amplitude="kappa", start=0.05, limits=(1e-4, 0.6),
     needs=("wavelengths",), source="Rasmussen et al. 2014 (JINST 9, C04027): near the back window "
     "the drift field is weaker; only light absorbed there, the blue, sees larger shifts")  # fmt: skip
class ChromaticWindow(Law):
    """Shifts change by kappa (1 - exp(-L0/L)), L the absorption length, L0 that at 620 nm."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        near = -np.expm1(-absorption_length(620) / absorption_length(exposure.wavelength))
        f = 1 + self.values["kappa"] * (near / -np.expm1(-1.0) - 1)
        return _scaled(terms, f, f)


@law("bf_anisotropy", "uniform", amplitude="eps", start=0.1, limits=(2e-4, 0.8),
     source="Antilogus et al. 2014 (JINST 9, C03048); Guyonnet et al. 2015 (A&A 575, A41): "
     "coefficients of the two axes are independent")  # fmt: skip
class AnisotropyUniform(Law):
    """kx (1 - eps/2), ky (1 + eps/2) at all distances."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        eps = self.values["eps"]
        return _scaled(terms, 1 - eps / 2, 1 + eps / 2)


@law("bf_anisotropy", "near", amplitude="eps", start=0.12, limits=(2e-4, 0.8),
     source="Astier & Regnault 2023: barriers of the two axes seal at different heights, which "
     "only near edges feel; here eps exp(-(r - 1/2)/length)")  # fmt: skip
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


@law("bf_long_range", "inverse_square", amplitude="amp", start=1e-8, limits=(1e-11, 2e-7),
     source="Rasmussen et al. 2016; Astier et al. 2019, fig. 10: decay slower than the image "
     "charges'; area change amp / r^2 within range")  # fmt: skip
class InverseSquare(_Tail):
    """Area changes amp / r^2 up to the range, from r d = amp ln(range / r)."""

    @classmethod
    def shape(cls, rng):
        return {"range": float(round(rng.uniform(14, 24), 2))}

    def inward(self, r):
        return self.values["amp"] * np.log(np.maximum(self.values["range"] / r, 1.0)) / r


@law("bf_long_range", "exponential", amplitude="amp", start=2e-9, limits=(1e-12, 5e-8),
     source="Holland et al. 2014 (JINST 9, C03057): field of the stored charge through an undepleted "
     "layer; area change amp exp(-r/length)")  # fmt: skip
class ExponentialTail(_Tail):
    """Area changes amp exp(-r / length), from r d = amp length (r + length) exp(-r / length)."""

    @classmethod
    def shape(cls, rng):
        return {"length": float(round(rng.uniform(2.0, 6.0), 3))}

    def inward(self, r):
        scale = self.values["length"]
        return self.values["amp"] * scale * (1 + scale / r) * np.exp(-r / scale)


@law("voltage_dependence", "linear", amplitude="delta", start=0.06, limits=(2e-4, 0.6),
     needs=("voltages",), source="Guyonnet et al. 2015 and Lage et al. 2017: strength against back "
     "bias; here linear, delta for 20 V towards less bias")  # fmt: skip
class VoltageLinear(Law):
    """Shifts change by delta for each 20 V from the first back bias."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        f = 1 + self.values["delta"] * (exposure.back_bias - REFERENCE[1]) / 20.0
        return _scaled(terms, f, f)


@law("voltage_dependence", "power", amplitude="delta", start=0.06, limits=(2e-4, 0.6),
     needs=("voltages",), source="Holland et al. 2014: drift time as a power of the voltage; here "
     "|V|^p with the change delta at +20 V")  # fmt: skip
class VoltagePower(Law):
    """Shifts carry a further factor |V / V0|^p; delta is its value at V0 + 20 V, less one."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def settle(self):
        delta = self.values.get("delta", 0.0)
        self.values["exponent"] = float(np.log1p(delta) / np.log(40.0 / 60.0))

    def terms(self, terms, exposure):
        f = (exposure.back_bias / REFERENCE[1]) ** self.values["exponent"]
        return _scaled(terms, f, f)


@law("voltage_dependence", "drop", amplitude="frac", start=0.1, limits=(5e-4, 0.9),
     needs=("voltages",), source="Juramy et al. 2020 (arXiv 2001.03223): part of a change of the "
     "substrate's voltage does not reach the sensor")  # fmt: skip
class VoltageDrop(Law):
    """Only (1 - frac) of a change of back bias reaches the silicon."""

    def device(self, device, exposure):
        change = exposure.back_bias - REFERENCE[1]
        return replace(device, vbb=device.vbb - self.values["frac"] * change)

    def settle(self):
        if self.setting is None:
            return
        d, frac = self.setting.nominal, self.values.get("frac", 0.0)
        k = [abs(edge_shifts(replace(d, vbb=v), 620)[1]).max() for v in (-40, -40 - 20 * frac)]
        self.values["delta"] = float(k[1] / k[0] - 1)


# -------------------------------------------------------------------- device and silicon
class _OffCard(Law):
    """One parameter of the card is wrong by a number of its sigmas."""

    choices: tuple[str, ...] = ()

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "_name": str(rng.choice(cls.choices))}

    def _sigma(self) -> float:
        name = self.values["_name"]
        if name == "vbb":
            return BACK_BIAS_ERROR
        return SPREAD[name] * getattr(self.setting.nominal, name)

    def device(self, device: Device, exposure):
        name = self.values["_name"]
        value = getattr(device, name) + self.values["sigmas"] * self._sigma()
        least = 0.05 * abs(getattr(self.setting.nominal, name))
        value = min(value, -least) if name == "vbb" else max(value, least)
        return replace(device, **{name: value})

    def settle(self):
        if self.setting is None or "sigmas" not in self.values:
            return
        name = self.values["_name"]
        value = getattr(self.setting.device, name) + self.values["sigmas"] * self._sigma()
        self.values["_value"] = float(value)

    def truth(self):
        return {self.values["_name"]: self.values["_value"]}


@law("device_parameter", "field", amplitude="sigmas", start=8.0, limits=(3.0, 60.0),
     source="Lage et al. 2017: thickness, doping and back bias set the drift "
     "field E_z")  # fmt: skip
class OffCardField(_OffCard):
    """Thickness, doping or back bias off the card."""

    choices = ("thickness", "doping", "vbb")


@law("device_parameter", "heights", amplitude="sigmas", start=6.0, limits=(3.0, 40.0),
     source="Astier & Regnault 2023: height of the stored charge and of the barriers, the quantities "
     "that fit a_ij")  # fmt: skip
class OffCardHeights(_OffCard):
    """Height of the packet or of a barrier off the card."""

    choices = ("h", "zx", "zy")


@law("silicon_physics", "hole_screening", amplitude="frac", start=0.15, limits=(5e-4, 0.9),
     source="Lage et al. 2017, section 3 (free holes in channel stops screen the field across them); "
     "here the share lost falls as stored charge repels the holes, exp(-Q/Q0)")  # fmt: skip
class HoleScreening(Law):
    """Sideways shifts lose frac exp(-Q/Q0) of their size."""

    @classmethod
    def draw(cls, rng, setting):
        return {"q0": float(round(rng.uniform(3e4, 1.5e5)))}

    def terms(self, terms, exposure):
        f, q0 = np.float32(self.values["frac"]), np.float32(self.values["q0"])
        if not f:
            return terms
        out = []
        for t in terms:
            out.append(Term(0 * t.kx, t.ky, t.source))
            out.append(Term(t.kx, 0 * t.ky, lambda q: q * (1 - f * np.exp(-q / q0))))
        return out

    def truth(self):
        return {"piece": "free holes in channel stops", **super().truth()}


@law("silicon_physics", "crowding", amplitude="spread", start=3e-7, limits=(1e-9, 3e-6),
     source="Lage et al. 2017, section 4, and Rasmussen et al. 2014: a full well's field falls and "
     "electrons diffuse into neighbours; spread grows with the mean charge of both pixels")  # fmt: skip
class Crowding(Law):
    """Charge diffuses between neighbours, spread [pixel^2 per electron] times their mean charge."""

    def stored(self, charge, exposure):
        s = np.float32(self.values["spread"] / 2)
        right, up = np.roll(charge, -1, 1), np.roll(charge, -1, 0)
        flow_x = s * 0.5 * (charge + right) * (right - charge)
        flow_y = s * 0.5 * (charge + up) * (up - charge)
        return charge + divergence(flow_x, flow_y)

    def truth(self):
        return {"piece": "charge-dependent diffusion", **super().truth()}


@law("lateral_diffusion", "einstein", amplitude="var", start=0.03, limits=(2e-4, 1.5),
     needs=("spots",), source="Fairfield et al. 2006 (IEEE TNS 53, 3877): "
     "sigma^2 = 2 (kT/q) t^2 / V")  # fmt: skip
class Einstein(Law):
    """Extra variance of spots var (T / T0) (V0 / V) [pixel^2]."""

    def _extra(self, e):
        return self.values["var"] * (e.temperature + 273.15) / 173.15 * REFERENCE[1] / e.back_bias

    def spot_shape(self, sx, sy, exposure):
        extra = self._extra(exposure)
        return np.sqrt(sx**2 + extra), np.sqrt(sy**2 + extra)


@law("lateral_diffusion", "hot_electrons", amplitude="var", start=0.03, limits=(2e-4, 1.5),
     needs=("spots",), source="Jacoboni et al. 1977 (Solid-State Electron. 20, 77): D/mu above "
     "kT/q in a high field, nearly without temperature; sigma^2 as |V|^-1/2")  # fmt: skip
class HotElectrons(Einstein):
    """Extra variance var (V0 / V)^(1/2), the same at all temperatures."""

    def _extra(self, e):
        return self.values["var"] * np.sqrt(REFERENCE[1] / e.back_bias)


@law("lateral_diffusion", "depth", amplitude="var", start=0.03, limits=(2e-4, 1.5),
     needs=("spots", "wavelengths"), source="Magnier et al. 2018 (PASP 130, 065002, Pan-STARRS "
     "diffusion variations): only light absorbed near the back crosses a layer of low field")  # fmt: skip
class DepthDiffusion(Einstein):
    """Extra variance of light absorbed within 10 um of the back, as a share of all light."""

    def _extra(self, e):
        share = -np.expm1(-10.0 / absorption_length(e.wavelength))
        return self.values["var"] * share / -np.expm1(-10.0 / absorption_length(620))


# -------------------------------------------------------------------- collection efficiency
@law("charge_loss", "exponential", amplitude="q", start=1e-7, limits=(1e-9, 4e-6),
     source="catalogue of the project, item 9: rate x exp(-q Q)")  # fmt: skip
class LossExponential(Law):
    """A fraction exp(-q Q) is collected at stored charge Q."""

    def efficiency(self, charge: Image):
        return np.exp(np.float32(-self.values["q"]) * charge)


@law("charge_loss", "langmuir", amplitude="q", start=1e-7, limits=(1e-9, 4e-6),
     source="Janesick 2001, Scientific CCDs, section 5 (surface states fill up); Langmuir form: the "
     "loss q Q / (1 + Q/Qs) saturates")  # fmt: skip
class LossLangmuir(Law):
    """A fraction 1 - q Q / (1 + Q / Qs) is collected."""

    @classmethod
    def draw(cls, rng, setting):
        return {"saturation_charge": float(round(rng.uniform(2e4, 8e4)))}

    def efficiency(self, charge: Image):
        q, top = np.float32(self.values["q"]), np.float32(self.values["saturation_charge"])
        return np.maximum(1 - q * charge / (1 + np.maximum(charge, 0) / top), 0)


@law("charge_loss", "root", amplitude="q", start=1e-7, limits=(1e-9, 4e-6),
     source="Shockley & Read 1952, Hall 1952: capture over a surface whose area grows as the square "
     "root of the packet; 1 - q 1e5 (Q/1e5)^(1/2)")  # fmt: skip
class LossRoot(Law):
    """A fraction 1 - q 1e5 sqrt(Q / 1e5) is collected."""

    def efficiency(self, charge: Image):
        x = np.sqrt(np.maximum(charge, 0) * np.float32(1e-5))
        return np.maximum(1 - np.float32(self.values["q"] * 1e5) * x, 0)

