"""Effects of the light, and of charge that was never light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from validation.concealed.effect import Effect, Range


@dataclass(frozen=True)
class PsfWings(Effect):
    """``frac`` of a spot's light is in a halo of ``sigma`` pixels about it."""

    word = "psf_wings"
    variants = {"": {"frac": Range(1e-3, 0.05, amplitude=True), "sigma": Range(3.0, 8.0)}}

    def spot_light(self, context):
        return {"halo": self.parameters["frac"], "halo_sigma": self.parameters["sigma"]}


@dataclass(frozen=True)
class Turbulence(Effect):
    """Illumination of flats varies from frame to frame: ``rms`` relative, Gaussian over ``corr``.

    ``corr`` [pixel]: the pattern's correlation falls as exp(-r^2 / (2 corr^2)).
    """

    word = "illumination_turbulence"
    variants = {"": {"rms": Range(1e-4, 2e-3, amplitude=True), "corr": Range(10.0, 60.0)}}

    def light(self, scene, context):
        if context.exposure.kind != "FLAT":
            return
        n = scene.light.shape[0]
        white = context.stream(self.word).standard_normal((n, n))
        f2 = scipy.fft.fftfreq(n)[:, None] ** 2 + scipy.fft.rfftfreq(n)[None, :] ** 2
        # the filter is sqrt of the pattern's power
        pass_band = np.exp(-((np.pi * self.parameters["corr"]) ** 2) * f2)
        pattern = scipy.fft.irfft2(scipy.fft.rfft2(white) * pass_band, s=(n, n))
        full = np.exp(-2 * (np.pi * self.parameters["corr"]) ** 2 * f2)
        weight = np.where(np.arange(f2.shape[1]) % (n // 2) == 0, 1.0, 2.0)
        pattern /= np.sqrt((full * weight).sum() / (n * n))
        scene.scale((1 + self.parameters["rms"] * pattern).astype(np.float32))


@dataclass(frozen=True)
class ShutterTiming(Effect):
    """Light lasts ``dt`` [s] longer than commanded, (1 + shade x) of it at x from -1 to 1."""

    word = "shutter_timing"
    variants = {
        "": {
            "dt": Range(5e-3, 5e-2, signed=True, amplitude=True),
            "shade": Range(-0.5, 0.5, "flat"),
        }
    }

    def light(self, scene, context):
        n = scene.light.shape[0]
        x = (np.arange(n) + 0.5) / n * 2 - 1
        longer = self.parameters["dt"] * (1 + self.parameters["shade"] * x)
        factor = 1 + longer / context.exposure.seconds
        scene.scale(factor.astype(np.float32)[None, :])


@dataclass(frozen=True)
class DarkHot(Effect):
    """Dark current beyond the nominal one: everywhere, or in hot columns; ``rate`` [e-/s].

    hot: ``columns`` whole columns, the same in every exposure.
    """

    word = "dark_hot"
    variants = {
        "dark": {"rate": Range(0.02, 1.0, amplitude=True)},
        "hot": {"rate": Range(1.0, 50.0, amplitude=True), "columns": Range(1, 6, "whole")},
    }

    def store(self, charge, context):
        n = charge.shape[1]
        rate = np.full(n, self.parameters["rate"])
        if self.variant == "hot":
            # golden-section places: spread over the sensor, no random draw needed
            hot = (np.arange(1, self.parameters["columns"] + 1) * 0.61803 % 1 * n).astype(
                int
            )
            rate[np.setdiff1d(np.arange(n), hot)] = 0.0
        doubled = 2 ** ((context.exposure.temperature + 100.0) / 6.0)
        mean = rate * context.exposure.seconds * doubled
        if not mean.any():
            return charge
        born = context.stream(self.word).poisson(np.broadcast_to(mean, charge.shape))
        return charge + born.astype(np.float32)


@dataclass(frozen=True)
class Fringing(Effect):
    """At 900 nm and beyond, response varies by ``amp`` as a wafer's thickness contours.

    ``period`` [pixel] between fringes at the middle of the sensor.
    """

    word = "fringing"
    variants = {"": {"amp": Range(1e-3, 2e-2, amplitude=True), "period": Range(15.0, 60.0)}}

    def light(self, scene, context):
        if context.exposure.wavelength < 900.0:
            return
        n = scene.light.shape[0]
        x, y = (np.arange(n) / n - 0.5)[None, :], (np.arange(n) / n - 0.5)[:, None]
        height = x + 0.6 * y + 0.7 * x * x - 0.5 * x * y + 0.4 * y * y
        phase = 2 * np.pi * n * height / self.parameters["period"]
        scene.even = scene.light
        scene.scale((1 + self.parameters["amp"] * np.sin(phase)).astype(np.float32))


@dataclass(frozen=True)
class CosmicRays(Effect):
    """Straight tracks, ``rate`` per minute on 256 x 256 pixels, readout time (5 s) included.

    A minimum-ionising particle leaves about 80 e-/um; cos^2 zenith angles; charge spreads by
    0.3 pixels.
    """

    word = "cosmic_rays"
    variants = {"": {"rate": Range(0.3, 30.0, amplitude=True)}}

    def store(self, charge, context):
        n = charge.shape[0]
        minutes = (context.exposure.seconds + 5.0) / 60.0
        stream = context.stream(self.word)
        number = stream.poisson(self.parameters["rate"] * minutes * (n / 256) ** 2)
        if not number:
            return charge
        charge = charge.copy()
        thick = context.device["thickness"] / context.device["pixel"]
        for _ in range(number):
            x, y = stream.uniform(0, n, 2)
            slope = np.tan(np.arccos(np.clip(stream.random(), 1e-3, 1) ** 0.25))
            length, turn = min(thick * slope, 4.0 * n), stream.uniform(0, 2 * np.pi)
            path = np.hypot(length, thick) * context.device["pixel"]
            pieces = max(int(4 * length), 8)
            energy = 80.0 * path * (1 + 0.2 * stream.exponential())
            at = (np.arange(pieces) + 0.5) / pieces * length
            spread = 0.3 * stream.standard_normal((2, pieces))
            columns = np.floor(x + at * np.cos(turn) + spread[0]).astype(int)
            rows = np.floor(y + at * np.sin(turn) + spread[1]).astype(int)
            inside = (rows >= 0) & (rows < n) & (columns >= 0) & (columns < n)
            share = stream.poisson(energy / pieces, pieces).astype(np.float32)
            np.add.at(charge, (rows[inside], columns[inside]), share[inside])
        return charge


LIGHT_EFFECTS = (PsfWings, Turbulence, ShutterTiming, DarkHot, Fringing, CosmicRays)
