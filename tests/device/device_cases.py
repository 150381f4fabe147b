"""Devices to test with, and the message of a refusal."""

from __future__ import annotations

import pytest

from bfsensor.device.device import Device
from bfsensor.errors import DeviceError

ITL = Device.load("itl_sta3800c")
E2V = Device.load("e2v_ccd250")


def refusal(call, *args, **kwargs):
    """Message of the DeviceError that a call raises."""
    with pytest.raises(DeviceError) as caught:
        call(*args, **kwargs)
    return str(caught.value)
