"""Figures and sentences of the real recordings, from the rows of ``real_recordings.ecsv``."""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from validation.real.real_rings import REFERENCE, WAVELENGTHS, bias_law
from validation.real.real_sbig import RUNS

Values = NDArray[np.float64]


def pick(table: Table, part: str, what: str, of: str = "") -> Table:
    """Rows of one number."""
    here = (np.array(table["part"]) == part) & (np.array(table["what"]) == what)
    return table[here & (np.array(table["of"]) == of)]


def one(table: Table, part: str, what: str, of: str = "") -> float:
    """The value of a row that there is once."""
    (found,) = pick(table, part, what, of)
    return float(found["value"])


def draw(part: str, table: Table) -> Any:
    """Figure of one recording."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    {"sbig": _sbig, "rings": _rings, "spots": _spots, "areas": _areas}[part](
        left, right, table
    )
    return figure


def say(part: str, table: Table) -> list[str]:
    """Sentences: what is concluded, and what is not."""
    makers = {
        "sbig": _say_sbig,
        "rings": _say_rings,
        "spots": _say_spots,
        "areas": _say_areas,
    }
    return makers[part](table)


def _sbig(left: Any, right: Any, table: Table) -> None:
    for ax, (fitted, other) in zip((left, right), (RUNS, RUNS[::-1]), strict=True):
        of = f"{fitted} to {other}"
        seen, told = (pick(table, "sbig", w, of) for w in ("measured", "predicted"))
        ax.axhline(
            0, color="0.6", lw=1, label="white noise with any near area change (baseline)"
        )
        ax.errorbar(
            seen["at"], seen["value"], seen["error"], fmt="o", ms=4, color="C0",
            label=f"{other}, not fitted",
        )  # fmt: skip
        ax.plot(
            told["at"], told["value"], "-", color="C1", label=f"predicted from {fitted}"
        )
        before, after = (one(table, "sbig", f"chi2 {w}", of) for w in ("before", "after"))
        ax.set(
            xscale="log", xlabel="level [e-]", ylabel="correlation at lag (1, 0)", ylim=(-0.06, 0.06),
            title=f"fitted {fitted}: chi-square of {other} {before:.0f} to {after:.0f} "
            f"({len(seen)} values)",
        )  # fmt: skip
        ax.title.set_fontsize(9)
        ax.legend(frameon=False, fontsize=7.5, loc="upper left")


def _rings(left: Any, right: Any, table: Table) -> None:
    seen, told = (pick(table, "rings", w) for w in ("amplitude", "predicted"))
    out = pick(table, "rings", "left out, error %")
    left.axhline(1, color="0.6", lw=1, label="achromatic (baseline)")
    left.plot(
        told["at"], told["value"], "-", color="C1", label="conversion depth, length fitted"
    )
    without = np.array([
        float(seen["value"][list(WAVELENGTHS).index(int(r["at"]))]) * (1 + float(r["value"]) / 100)
        for r in out
    ])  # fmt: skip
    left.plot(
        out["at"], without, "x", color="C3", label="predicted, this wavelength left out"
    )
    left.errorbar(
        seen["at"], seen["value"], seen["error"], fmt="o", ms=4, color="C0", label="ITL-098"
    )
    left.set(
        xlabel="wavelength [nm]",
        ylabel=f"ring amplitude over that at {WAVELENGTHS[REFERENCE]} nm",
        ylim=(0.4, 1.15),
    )
    left.legend(frameon=False, fontsize=7.5, loc="lower left")
    (ratio,) = pick(table, "rings", "bias ratio")
    volts = pick(table, "rings", "volts of the gates")
    bias = np.linspace(0, 80, 41)
    right.axhline(1, color="0.6", lw=1, label="bias-free (baseline)")
    wave = one(table, "rings", "wave number")
    for n, r in enumerate((volts[0], volts[-1])):
        curve = bias_law(bias, float(r["value"]), float(r["at"]), wave)
        right.plot(
            bias, curve / curve[0], ls=("-", ":")[n], color="C1",
            label=f"drift time, V0 = {r['value']:.1f} V, doping {r['at']:.1f}e12 cm$^{{-3}}$",
        )  # fmt: skip
    right.errorbar(
        [0, 70], [1, ratio["value"]], [0, ratio["error"]], fmt="o", ms=5, color="C0",
        label="e2v-260",
    )  # fmt: skip
    right.set(
        xlabel="back bias, size [V]",
        ylabel="ring amplitude over that at 0 V",
        ylim=(0, 1.1),
    )
    right.legend(frameon=False, fontsize=7.5, loc="center right")


def _spots(left: Any, right: Any, table: Table) -> None:
    name = "all scatter"
    ofs = [
        str(r) for r in table["of"][np.array(table["what"]) == "slope x"] if name in str(r)
    ]
    for n, of in enumerate(ofs):
        (x,), (y,) = (pick(table, "spots", f"slope {a}", of) for a in "xy")
        left.errorbar(
            x["value"], y["value"], y["error"], x["error"], fmt="o", ms=5, color=f"C{n}",
            label=of.split(",")[0],
        )  # fmt: skip
    others = [o for o in ofs if "SEGMENT02" not in o]
    ratio = np.mean([one(table, "spots", "slope y", o) for o in others]) / np.mean(
        [one(table, "spots", "slope x", o) for o in others]
    )
    grid = np.array([0.6, 1.4])
    left.plot(
        grid, ratio * grid, "-", color="0.6", lw=1, label="gain alone moves along here"
    )
    left.set(xlabel="growth in x [% per 1e6 e-]", ylabel="growth in y [% per 1e6 e-]")
    left.legend(frameon=False, fontsize=7.5)
    names = [o.split(",")[0] for o in ofs]
    right.bar(names, [one(table, "spots", "stands out", o) for o in ofs], color="C0")
    right.axhline(
        one(table, "spots", "chi2_gain", name), color="0.4", lw=1, ls="--",
        label="chi-square of gain alone (3 degrees)",
    )  # fmt: skip
    right.set(ylabel="decrease when its ratio y / x is free", ylim=(0, 26))
    right.legend(frameon=False, fontsize=8, loc="upper left")


def _areas(left: Any, right: Any, table: Table) -> None:
    for ax, what, title in (
        (left, "residual", "as the card has it (-50 V)"),
        (right, "residual explained", "operating point found"),
    ):
        rows = pick(table, "areas", what, "e2v")
        image = np.full((5, 5), np.nan)
        for r in rows:
            j, i = divmod(int(r["at"]), 10)
            image[j, i] = r["value"]
        shown = ax.imshow(image, origin="lower", cmap="RdBu_r", vmin=-10, vmax=10)
        for (j, i), z in np.ndenumerate(image):
            if np.isfinite(z):
                ax.text(i, j, f"{z:+.1f}", ha="center", va="center", fontsize=8,
                        color="w" if abs(z) > 6 else "k")  # fmt: skip
        ax.set(xlabel="lag x", ylabel="lag y", title=f"E2V against e2v_ccd250, {title}")
        ax.title.set_fontsize(9)
        ax.figure.colorbar(shown, ax=ax, label="(measured - predicted) / error")


def _say_sbig(table: Table) -> list[str]:
    out = []
    for fitted, other in (RUNS, RUNS[::-1]):
        of = f"{fitted} to {other}"
        before, after, n, part = (
            one(table, "sbig", w, of)
            for w in ("chi2 before", "chi2 after", "values", "removed")
        )
        without = np.array(
            pick(table, "sbig", "removed without a flat", of)["value"], float
        )
        (told,) = pick(table, "sbig", "p", fitted)
        out.append(
            f"{fitted} fitted: on {other} the chi-square of the lag (1, 0) falls from {before:.0f} to "
            f"{after:.0f} of {n:.0f}, {100 * part:.0f} % of its excess; diagnosed again without one "
            f"flat of {fitted} at a time, median {100 * np.median(without):.0f} %, least "
            f"{100 * without.min():.0f} %."
        )
        out.append(f"The tool's words: {told['said']}")
    out.append(
        "Not concluded: which part of the readout; what it names beside the free form in one run it "
        "does not name in the other, and that is not believed; no brighter-fatter effect is claimed."
    )
    return out


def _say_rings(table: Table) -> list[str]:
    (card,), (even,) = (pick(table, "rings", "factor", o) for o in ("card", "even field"))
    flat, length, fitted = (
        one(table, "rings", f"chi2 {w}", "card")
        for w in ("achromatic", "silicon", "fitted")
    )
    out = pick(table, "rings", "left out, error %")
    errors = ", ".join(
        f"{r['at']:.0f} nm {r['value']:+.1f} (measured to {r['error']:.1f})" for r in out
    )
    (warm,) = pick(table, "rings", "temperature")
    (ratio,) = pick(table, "rings", "bias ratio")
    volts = pick(table, "rings", "volts of the gates")
    return [
        f"ITL-098: achromatic rings have a chi-square of {flat:.0f} for 7 amplitudes; displacement "
        f"integrated from the conversion depth {length:.0f} with nothing fitted, {fitted:.1f} with an "
        f"absorption length of {card['value']:.2f} +- {card['error']:.2f} of silicon's at 173 K.",
        f"Amplitudes at wavelengths left out of the fit, error in %: {errors}.",
        f"e2v-260: rings at 70 V are {ratio['value']:.3f} +- {ratio['error']:.3f} of those at 0 V "
        f"(bias-free: 1); drift time in the field of 70 V + V0 asks for V0 = {volts[0]['value']:.1f} "
        f"+- {abs(volts[0]['error']):.1f} V without doping to {volts[-1]['value']:.1f} +- "
        f"{abs(volts[-1]['error']):.1f} V with the card's.",
        f"Not concluded: whether the length is short or the silicon warmer ({warm['value']:.0f} +- "
        f"{warm['error']:.0f} K fits as well) or the field more even than the card's (factor "
        f"{even['value']:.2f} +- {even['error']:.2f} then): temperature and voltages are not "
        "published; V0 and doping are tied by two biases; the law 1 / (V + V0) itself is not tested by "
        "two points.",
    ]


def _say_spots(table: Table) -> list[str]:
    out = []
    for name in ("all scatter", "shared scatter taken off"):
        same, gain, others, p, single, p_others = (
            one(table, "spots", w, name)
            for w in (
                "chi2_same",
                "chi2_gain",
                "chi2 of the others",
                "p_gain",
                "p_single",
                "p_others",
            )
        )
        out.append(
            f"{name}: one growth for all has a chi-square of {same:.0f} (6 degrees), gain alone "
            f"{gain:.1f} (3; p {p:.2g}); SEGMENT02 apart, the other three have {others:.1f} (2; p "
            f"{p_others:.2g}); a segment as far apart as it comes by chance with p {single:.2g}, the "
            "largest of four counted."
        )
    slope = {a: one(table, "spots", f"slope {a}", "SEGMENT02, all scatter") for a in "xy"}
    out.append(
        f"SEGMENT02 grows by {slope['x']:.2f} % in x and {slope['y']:.2f} % in y per 1e6 e-: a gain "
        "would scale both alike.  Not concluded: what it is instead (its spots are also wider in x "
        "without charge: optics or the segment), and errors are of scatter about lines of five points."
    )
    return out


def _say_areas(table: Table) -> list[str]:
    out = []
    for of in dict.fromkeys(
        str(o) for o in table["of"][np.array(table["part"]) == "areas"]
    ):
        here = pick(table, "areas", "p", of)
        if len(here):
            (square,) = pick(table, "areas", "chi2", of)
            out.append(
                f"{of}: chi-square {square['value']:.0f} of {square['at']:.0f}. {here['said'][0]}"
            )
    singles = sorted(
        table[np.array(table["what"]) == "one parameter"], key=lambda r: r["at"]
    )
    text = "; ".join(
        f"{r['of']} {r['value']:.4g} +- {r['error']:.2g} ({r['said']}): {r['at']:.0f}"
        for r in singles
    )
    out.append(
        f"E2V, one parameter of the device free at a time, chi-square left of 23: {text}."
    )
    pulls = [r for r in table if r["what"] == "pull"]
    text = ", ".join(f"{str(r['of']).split(', ')[1]} {r['value']:+.1f}" for r in pulls)
    out.append(
        f"All of them free within the card (spreads): nothing stands out with {text}."
    )
    out.append(
        "Not concluded: anything of ITL's operating point (errors too large); of E2V back bias and "
        "gate low (-6 to -7.2 V) move together and are not told apart, and quantities of the card "
        "within two spreads each, all together, do as well as the voltage: that it was -70 V is "
        "known from the published run, not from these a_ij; a_00 and conservation of "
        "charge are not tested; errors are taken as independent."
    )
    return out
