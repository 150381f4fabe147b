"""The differential response of a device: shifts of pixel edges per electron, derivatives, emulator."""
