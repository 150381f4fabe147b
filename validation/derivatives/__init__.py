"""Derivatives of the response by a device's quantities agree with differences of solutions."""
