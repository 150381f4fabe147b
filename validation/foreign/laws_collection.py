"""Laws of the device off its card, silicon that a simulation lacks, diffusion, and loss of charge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from validation.foreign.collection import Image, Term, divergence
from validation.foreign.device import REFERENCE, SPREAD, Device, absorption_length
from validation.foreign.law import Law, after, law
from validation.foreign.laws_silicon import either_sign

BACK_BIAS_ERROR = 1.0
"""Sigma of a back bias about its card [V]; chosen, as cards state none."""


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


@law(
    "device_parameter",
    "field",
    amplitude="sigmas",
    start=15,
    limits=(3.0, 60.0),
    source="Lage et al. 2017: thickness, doping and back bias set the drift field E_z",
)
class OffCardField(_OffCard):
    """Thickness, doping or back bias off the card."""

    choices = ("thickness", "doping", "vbb")


@law(
    "device_parameter",
    "heights",
    amplitude="sigmas",
    start=30,
    limits=(3.0, 40.0),
    source="Astier & Regnault 2023: height of the stored charge and of the "
    "barriers, the quantities that fit a_ij",
)
class OffCardHeights(_OffCard):
    """Height of the packet or of a barrier off the card."""

    choices = ("h", "zx", "zy")


@law(
    "silicon_physics",
    "hole_screening",
    amplitude="frac",
    start=0.4,
    limits=(0.0005, 0.9),
    source="Lage et al. 2017, section 3 (free holes in channel stops screen the "
    "field across them); here the share lost falls as stored charge repels "
    "the holes, exp(-Q/Q0)",
)
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
            out.append(
                Term(t.kx, 0 * t.ky, after(t, lambda q: q * (1 - f * np.exp(-q / q0))))
            )
        return out

    def truth(self):
        return {"piece": "free holes in channel stops", **super().truth()}


@law(
    "silicon_physics",
    "crowding",
    amplitude="spread",
    start=3e-07,
    limits=(1e-09, 3e-06),
    source="Lage et al. 2017, section 4, and Rasmussen et al. 2014: a full well's "
    "field falls and electrons diffuse into neighbours; spread grows with "
    "the mean charge of both pixels",
)
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


@law(
    "lateral_diffusion",
    "einstein",
    amplitude="var",
    start=0.012,
    limits=(0.0002, 1.5),
    needs=("spots",),
    source="Fairfield et al. 2006 (IEEE TNS 53, 3877): sigma^2 = 2 (kT/q) t^2 / V",
)
class Einstein(Law):
    """Extra variance of spots var (T / T0) (V0 / V) [pixel^2]."""

    def _extra(self, e):
        return (
            self.values["var"]
            * (e.temperature + 273.15)
            / 173.15
            * REFERENCE[1]
            / e.back_bias
        )

    def spot_shape(self, sx, sy, exposure):
        extra = self._extra(exposure)
        return np.sqrt(sx**2 + extra), np.sqrt(sy**2 + extra)


@law(
    "lateral_diffusion",
    "hot_electrons",
    amplitude="var",
    start=0.012,
    limits=(0.0002, 1.5),
    needs=("spots",),
    source="Jacoboni et al. 1977 (Solid-State Electron. 20, 77): D/mu above kT/q "
    "in a high field, nearly without temperature; sigma^2 as V^(-1/2)",
)
class HotElectrons(Einstein):
    """Extra variance var (V0 / V)^(1/2), the same at all temperatures."""

    def _extra(self, e):
        return self.values["var"] * np.sqrt(REFERENCE[1] / e.back_bias)


@law(
    "lateral_diffusion",
    "depth",
    amplitude="var",
    start=0.012,
    limits=(0.0002, 1.5),
    needs=("spots", "wavelengths"),
    source="Magnier et al. 2018 (PASP 130, 065002, Pan-STARRS diffusion "
    "variations): only light absorbed near the back crosses a layer of low "
    "field",
)
class DepthDiffusion(Einstein):
    """Extra variance of light absorbed within 10 um of the back, as a share of all light."""

    def _extra(self, e):
        share = -np.expm1(-10.0 / absorption_length(e.wavelength))
        return self.values["var"] * share / -np.expm1(-10.0 / absorption_length(620))


# -------------------------------------------------------------------- collection efficiency
@law(
    "charge_loss",
    "exponential",
    amplitude="q",
    start=1e-07,
    limits=(1e-09, 4e-06),
    source="catalogue of the project, item 9: rate x exp(-q Q)",
)
class LossExponential(Law):
    """A fraction exp(-q Q) is collected at stored charge Q."""

    def efficiency(self, charge: Image):
        return np.exp(np.float32(-self.values["q"]) * charge)


@law(
    "charge_loss",
    "langmuir",
    amplitude="q",
    start=1e-07,
    limits=(1e-09, 4e-06),
    source="Janesick 2001, Scientific CCDs, section 5 (surface states fill up); "
    "Langmuir form: the loss q Q / (1 + Q/Qs) saturates",
)
class LossLangmuir(Law):
    """A fraction 1 - q Q / (1 + Q / Qs) is collected."""

    @classmethod
    def draw(cls, rng, setting):
        return {"saturation_charge": float(round(rng.uniform(2e4, 8e4)))}

    def efficiency(self, charge: Image):
        q, top = np.float32(self.values["q"]), np.float32(self.values["saturation_charge"])
        return np.maximum(1 - q * charge / (1 + np.maximum(charge, 0) / top), 0)


@law(
    "charge_loss",
    "root",
    amplitude="q",
    start=1e-07,
    limits=(1e-09, 4e-06),
    source="Shockley & Read 1952, Hall 1952: capture over a surface whose area "
    "grows as the square root of the packet; 1 - q 1e5 (Q/1e5)^(1/2)",
)
class LossRoot(Law):
    """A fraction 1 - q 1e5 sqrt(Q / 1e5) is collected."""

    def efficiency(self, charge: Image):
        x = np.sqrt(np.maximum(charge, 0) * np.float32(1e-5))
        return np.maximum(1 - np.float32(self.values["q"] * 1e5) * x, 0)
