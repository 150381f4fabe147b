"""Configurations of Poisson_CCD say the device, its areas are read, and its changes are used."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.device.parts import BuriedChannel, Implant, Ripple
from bfsensor.device.poisson_ccd import import_poisson_ccd, read_configuration
from bfsensor.device.quantities import quantities
from bfsensor.errors import DeviceError
from validation.silicon import __main__ as cases
from validation.silicon import truths
from validation.silicon.engines_compared import rows_of
from validation.silicon.other_engine import (
    CENTRE,
    FRONT,
    PIXELS,
    Run,
    area_changes,
    area_within,
    change_ratio,
    configuration,
    cramping,
    plane,
    planes,
    ratio_of_areas,
    read_areas,
)

BINARY = os.environ.get("POISSON_CCD")


def written(device, run, folder):
    path = folder / f"{device.name}.cfg"
    path.write_text(configuration(device, run))
    return path


@pytest.mark.parametrize(
    "name", ["itl_sta3800c", "e2v_ccd250", "itl_sta3800c_2019", "e2v_ccd250_2019"]
)
def test_the_importer_reads_the_same_device(name, tmp_path):
    device = Device.load(name)
    back = import_poisson_ccd(written(device, Run(), tmp_path))
    for part in ("pixel", "material", "edge"):
        assert getattr(back, part) == getattr(device, part)
    assert (back.gates.phases, back.gates.collecting_phases) == (
        device.gates.phases,
        device.gates.collecting_phases,
    )
    # Units are changed by powers of ten, there and back: two roundings.
    own, again = quantities(device), quantities(back)
    for key, quantity in own.items():
        if not key.startswith(("well.", "transport.", "material.")):
            assert again[key].value == pytest.approx(quantity.value, rel=1e-15), key


def test_a_uniform_implant_and_a_region_without_any_are_written(tmp_path):
    device = Device.load("itl_sta3800c")
    channel = BuriedChannel(implants=(Implant("box", 9000.0, depth=0.4),))
    stop = dataclasses.replace(device.channel_stop, implants=())
    other = dataclasses.replace(device, channel=channel, channel_stop=stop)
    back = import_poisson_ccd(written(other, Run(), tmp_path))
    assert back.channel == channel and back.channel_stop == stop


def test_devices_that_the_program_does_not_have_are_refused():
    device = Device.load("itl_sta3800c")
    wide = dataclasses.replace(device.pixel, pitch_y=12.0)
    rings = dataclasses.replace(device.silicon, ripples=(Ripple("plane", 0.01, 80.0),))
    box = dataclasses.replace(device.channel, implants=(Implant("box", 9000.0, depth=0.4),))
    for part, value, why in (
        ("pixel", wide, "square"), ("silicon", rings, "ripples"), ("channel", box, "uniform"),
    ):  # fmt: skip
        with pytest.raises(DeviceError, match=why):
            configuration(dataclasses.replace(device, **{part: value}), Run())


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_all_pixels_are_charged_and_the_searched_ones_come_last(reach, tmp_path):
    run = Run(level=30_000.0, excess=7_000.0, reach=reach)
    keys = read_configuration(written(Device.load("itl_sta3800c"), run, tmp_path))
    charges = {}
    for n in range(int(keys["NumberofFilledWells_0"])):
        at = tuple(float(v) / 10 - 0.5 for v in keys[f"FilledPixelCoords_0_{n}"].split())
        charges[at] = int(keys[f"CollectedCharge_0_{n}"])
        inside = all(CENTRE <= k <= CENTRE + reach for k in at)
        assert inside == (n >= PIXELS**2 - (reach + 1) ** 2)
    assert len(charges) == PIXELS**2 and charges.pop((CENTRE, CENTRE)) == 37_000
    assert set(charges.values()) == {30_000}


@pytest.mark.parametrize("thickness", [85.0, 100.0, 115.0, 200.0])
def test_the_front_of_the_mesh_does_not_move_with_the_thickness(thickness):
    exponent = cramping(thickness)
    assert plane(FRONT, thickness, exponent) == pytest.approx(plane(FRONT, 100.0, 10.0))
    assert plane(thickness, thickness, exponent) == pytest.approx(planes(thickness))
    if abs(thickness - 100) < 20:
        for height in (0.1, 0.5, 2.0):
            there, here = plane(height, thickness, exponent), plane(height, 100.0, 10.0)
            # Half of what the mesh's own stretching by the thickness moves it at least.
            assert abs(there / here - 1) < 0.5 * abs(thickness / 100 - 1) + 1e-12


def boundary(centre, sides, number=132, step=0.0):
    """Lines of a file of vertices: rays from a centre to the nearest of four sides, less a step."""
    lines = []
    for theta in (np.arange(number) + 0.5) * 2 * np.pi / number:
        radii = np.linspace(4.0, 7.5, 200_001)
        x, y = radii * np.cos(theta), radii * np.sin(theta)
        right, top, left, bottom = sides
        inside = (x < right(y)) & (y < top(x)) & (x > left(y)) & (y > bottom(x))
        r = radii[inside].max() - step
        at = (*centre, theta, centre[0] + r * np.cos(theta), centre[1] + r * np.sin(theta))
        lines.append("".join(f"{v:<15.4f}" for v in at))
    return lines


def square(moved=0.0):
    """Sides of a pixel of 10 um whose right side bulges and whose others are tilted."""
    return (
        lambda y: 5 + moved * (1 - (y / 5) ** 2), lambda x: 5 + 0.01 * x,
        lambda y: -5 + 0.0 * y, lambda x: -5 + 0.01 * x,
    )  # fmt: skip


def written_vertices(folder, bulges, step=0.0):
    path = folder / "run_0_Vertices.dat"
    lines = ["X0             Y0             Theta          X              Y"]
    for (i, j), moved in bulges.items():
        lines += boundary((35.0 + 10 * i, 35.0 + 10 * j), square(moved), step=step)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_areas_are_read_as_changes_by_electron(tmp_path):
    bulges = {(0, 0): -0.3, (1, 0): 0.02, (0, 1): 0.05, (1, 1): 0.01}
    # The mean of what the search leaves out: between nothing and 10 um / 2^16 along each ray.
    path = written_vertices(tmp_path, bulges, step=10.0 / 2**17)
    a = read_areas(path, 10.0, 40_000.0)
    # A parabola of height h over 10 um has the area 20 h / 3.  The rays have steps of 2e-5 um and four
    # decimals, together 1e-4 um on 132 of them; a sine of their mean would have 4e-4 um^2.
    for (i, j), moved in bulges.items():
        assert a[j, i] == pytest.approx(moved * 20 / 3 / 100 / 40_000, abs=1e-3 / 4e6)
    path = written_vertices(tmp_path, {(0, 0): 0.0, (1, 0): 0.0, (1, 1): 0.0})
    with pytest.raises(ValueError, match=r"no pixel \(0, 1\)"):
        read_areas(path, 10.0, 40_000.0)


def test_sides_with_kinks_and_with_few_vertices_are_refused(tmp_path):
    sides = list(square())
    sides[1] = lambda x: np.where(x > 1, 5.2, 5.0)
    rows = [line.split() for line in boundary((0.0, 0.0), sides)]
    points = np.array(rows, float)[:, 3:]
    with pytest.raises(ValueError, match="smooth"):
        area_within(points, 10.0)
    with pytest.raises(ValueError, match="only"):
        area_within(points[::4], 10.0)


def test_ratios_are_a_lags_own_near_and_common_beyond():
    before = np.arange(1.0, 10.0).reshape(3, 3)
    after = before * 1.5
    after[0, 1] *= 1.1
    after[2, 2] += 1.0
    ratio = ratio_of_areas(before, after, lags=5)
    far = before[2].sum() + before[:2, 2].sum()
    assert ratio[0, 1] == pytest.approx(1.65) and ratio[1, 0] == pytest.approx(1.5)
    assert ratio[0, 2] == ratio[4, 4] == ratio[2, 1] == pytest.approx(1.5 + 1 / far)


def test_truths_have_the_programs_change_at_the_back_and_ours_between_colours(monkeypatch):
    device = Device.load("itl_sta3800c")
    asked = {"silicon.thickness": 2.0}
    thicker = change_parameter(device, "silicon.thickness", 2.0)
    ratio = np.full((truths.LAGS, truths.LAGS), 1.2)
    shape = np.linspace(1.0, 2.0, truths.LAGS**2).reshape(ratio.shape)

    def areas(of, wavelengths):
        more = 1.1 if of == thicker else 1.0
        colour = {None: 1.0, 620.0: 0.99, 950.0: 0.8}
        other = {None: 1.0, 620.0: 1.0, 950.0: 0.98}
        return [
            more * colour[w] * shape * (other[w] if of == thicker else 1.0)
            for w in wavelengths
        ]

    def solved(binary, before, after, *, lags, known):
        assert (before, after, lags) == (device, thicker, truths.LAGS)
        return ratio

    monkeypatch.setattr(truths, "areas", areas)
    monkeypatch.setattr(truths, "change_ratio", solved)
    plain, full = truths.by_poisson_ccd("none", device, asked, (620.0, 950.0), {})
    assert plain == pytest.approx(np.array([0.99 * shape, 0.8 * shape]))
    assert full == pytest.approx(np.array([1.2 * 0.99 * shape, 1.2 * 0.8 * 0.98 * shape]))


def test_half_of_the_cases_are_the_programs_and_change_what_it_has():
    device = Device.load("itl_sta3800c")
    drawn = [
        cases.draw_case(np.random.default_rng([3119, n]), device, False, cases.PROGRAM)
        for n in range(200)
    ]
    own = [c for c in drawn if c["engine"] == cases.PROGRAM]
    inside = sum(not c["outside"] for c in drawn)
    # Four standard errors of a half.
    assert abs(len(own) - inside / 2) < 4 * (inside / 4) ** 0.5
    names = {name for c in own for name in c["change"]}
    assert names == set(truths.POISSON_CCD)
    with pytest.raises(ValueError, match="binary"):
        cases.tables_of(device, own[0] | {"change": {}, "scatter": {}}, (-50.0,))


def test_dots_are_outside_of_a_device_without_dots_alone():
    def strange(name):
        drawn = (
            cases.draw_case(
                np.random.default_rng([3, n]), Device.load(name), False, "poisson"
            )
            for n in range(100)
        )
        return {name for c in drawn if c["outside"] for name in c["change"]}

    assert strange("itl_sta3800c") == set(cases.OUTSIDE)
    assert strange("e2v_ccd250") == set(cases.OUTSIDE) - {truths.DOTS}


def test_a_program_that_fails_is_said(tmp_path):
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho no such device\n")
    program.chmod(0o755)
    with pytest.raises(ValueError, match="no such device"):
        area_changes(program, Device.load("itl_sta3800c"), Run())


def test_solutions_are_not_made_twice(tmp_path):
    bulges = {(i, j): 0.02 for i in range(3) for j in range(3)} | {(0, 0): -0.3}
    made, count = written_vertices(tmp_path, bulges), tmp_path / "count"
    program = tmp_path / "program"
    program.write_text(f"#!/bin/sh\necho run >> {count}\ncp {made} run_0_Vertices.dat\n")
    program.chmod(0o755)
    device, known = Device.load("itl_sta3800c"), {}
    other = change_parameter(device, "silicon.background_doping", 0.1)
    for _ in range(2):
        ratio = change_ratio(program, device, other, lags=5, known=known)
        assert ratio == pytest.approx(1.0)
    assert count.read_text().count("run") == 2
    # Areas that grow beside a pixel that grows are no answer to charge.
    written_vertices(tmp_path, bulges | {(0, 0): 0.3})
    with pytest.raises(ValueError, match="repels"):
        area_changes(program, device, Run())


def test_rows_say_changes_in_percent_and_in_units_of_device_files():
    device = Device.load("itl_sta3800c")
    change = {"channel_stop.implant[0].dose": -13500.0}
    before, after = np.array([[-1.0, 2.0], [4.0, 5.0]]), np.array([[-1.1, 2.0], [3.0, 5.0]])
    rows = rows_of(device, change, (before, before), (after, before), "", 60.0)
    assert [(r["i"], r["j"]) for r in rows] == [(0, 0), (1, 0), (0, 1), (1, 1)]
    assert [r["ours"] for r in rows] == pytest.approx([10.0, 0.0, -25.0, 0.0])
    assert {(r["unit"], r["theirs"]) for r in rows} == {("cm-2", 0.0)}
    assert [r["by"] for r in rows] == pytest.approx([-1.35e12] * 4)


@pytest.mark.skipif(
    BINARY is None, reason="the environment variable POISSON_CCD names no binary of it"
)
def test_the_program_moves_areas_as_published():
    """a_00 and a_01 of the published configuration of ITL as its own polygons are at scale 1."""
    run = Run(level=0.0, excess=100_000.0, reach=1, relaxation=1.8, cycles=128)
    a, _ = area_changes(Path(str(BINARY)), Device.load("itl_sta3800c"), run)
    # Smooth sides instead of polygons, and 8 instead of 10 pixels: 1 % at the centre, 3 % beside it.
    assert a[0, 0] == pytest.approx(-1.005e-6, rel=0.015)
    assert a[1, 0] == pytest.approx(1.804e-7, rel=0.04)
