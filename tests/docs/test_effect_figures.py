"""Every class of effects has a picture, and the picture shows the effect."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.diagnose.report.class_words import CLASS_WORDS, PIECE_WORDS
from bfsensor.effects.device_parameter import DeviceParameter
from bfsensor.effects.library import LIBRARY
from tests.docs.pages import DOCS, load

FIGURES, PARTS = load("effect_figures"), load("effect_figures.parts")
LONG = ("device_parameter", "charge_loss", "saturation")
"""Pictures that solve a device or draw with the sensor: seconds each."""
OTHERWISE = ("outside_library", "silicon_physics")
"""Words that are no class of effects of their own: the last one is of quantities of devices."""


def test_every_class_has_a_picture():
    classes = {kind.word for kind in (*LIBRARY, DeviceParameter)}
    assert set(FIGURES.PICTURES) == classes == set(CLASS_WORDS) - set(OTHERWISE)
    for word, shown in FIGURES.PICTURES.items():
        assert shown.caption.endswith("."), word


def contents(figure):
    """Numbers that a figure shows."""
    found = []
    for ax in figure.axes:
        found += [np.asarray(line.get_ydata(), float).ravel() for line in ax.lines]
        found += [np.asarray(image.get_array(), float).ravel() for image in ax.images]
    return np.concatenate(found)


def check(word, monkeypatch):
    figure = FIGURES.PICTURES[word].draw()
    panels = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    for ax in panels:
        for label in (ax.get_xlabel(), ax.get_ylabel()):
            assert label, word
    shown = contents(figure)
    assert np.isfinite(shown).all()
    # The same with effects of no strength is another picture.
    make = PARTS.make_effect
    monkeypatch.setattr(PARTS, "make_effect", lambda *given: make(*given).scaled(0.0))
    assert not np.array_equal(contents(FIGURES.PICTURES[word].draw()), shown)
    return figure


@pytest.mark.parametrize("word", [w for w in FIGURES.PICTURES if w not in LONG])
def test_pictures_show_their_effects(word, monkeypatch):
    check(word, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("word", LONG[1:])
def test_pictures_drawn_by_the_sensor_show_their_effects(word, monkeypatch):
    check(word, monkeypatch)


@pytest.mark.slow
def test_the_picture_of_another_thickness_shows_it():
    left, right, *_ = FIGURES.PICTURES["device_parameter"].draw().axes
    off, on = (line.get_ydata() for line in left.lines)
    # A thicker sensor lets charge act over a longer path: farther pixels gain more.
    assert (on[1:] > off[1:]).all()
    assert np.abs(right.images[0].get_array()).max() > 5


def test_every_piece_of_silicon_physics_has_a_picture_and_its_page_shows_it():
    pieces = load("effect_figures.pieces")
    assert set(pieces.PIECES) == {*PIECE_WORDS, "back_bias", "gate_high", "gate_low"}
    page = (DOCS / "concepts" / "silicon_pieces.md").read_text()
    for name, shown in pieces.PIECES.items():
        assert shown.caption.endswith(".") and f"effects/piece_{name}.png" in page
        assert shown.caption in " ".join(page.split())
        figure = shown.draw()
        assert np.isfinite(contents(figure)).all() and figure.axes[0].texts
        for ax in figure.axes:
            assert ax.get_xlabel() and ax.get_ylabel()


def test_pictures_are_kept_while_their_code_is_the_same(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        FIGURES, "draw_all", lambda folder: (folder.mkdir(), drawn.append(1))
    )
    FIGURES.draw_once(tmp_path / "here")
    FIGURES.draw_once(tmp_path / "here")
    assert drawn == [1]
    (tmp_path / "here" / "digest.txt").write_text("of other code")
    monkeypatch.setattr(FIGURES, "draw_all", lambda folder: drawn.append(2))
    FIGURES.draw_once(tmp_path / "here")
    assert drawn == [1, 2]
