"""Campaigns on whose pixels effects are held are measured once and kept."""

import pytest

from tests.measured import measure_once
from validation.effects import effects_on_pixels


@pytest.fixture(autouse=True)
def _measured_once(monkeypatch):
    monkeypatch.setattr(effects_on_pixels, "measure_channels", measure_once)
