"""What each class of effects is, in plain words."""

from __future__ import annotations

CLASS_WORDS = {
    "cti_serial": "charge left behind at each serial transfer",
    "cti_parallel": "charge left behind at each parallel transfer",
    "trap_serial": "a trap of fixed size in the serial register",
    "electronic_memory": "the amplifier or its clamp remembers earlier pixels",
    "interpixel_coupling": "neighbours share signal after collection, at all signals alike",
    "amp_crosstalk": "a fraction of one amplifier's signal in another",
    "correlated_noise": "read noise correlated in time or between amplifiers",
    "bias_instability": "the bias level moves between frames, rows or along rows",
    "gain_nonlinearity": "the response against signal is curved",
    "adc_bits": "the converter's code widths are wrong",
    "gain_drift": "the gain changes with time",
    "bf_nonlinear": "pixel boundaries do not shift in proportion to the stored charge",
    "bf_chromatic": "the brighter-fatter effect depends on wavelength otherwise than simulated",
    "bf_anisotropy": "boundaries shift in x and y otherwise than the device allows",
    "bf_long_range": "boundary shifts fall more slowly with distance than electrostatics says",
    "device_parameter": "a quantity of the device card is wrong by far more than its spread",
    "voltage_dependence": "the dependence on back bias is another than simulated",
    "lateral_diffusion": "electrons diffuse more than simulated",
    "tree_rings": "circular pattern of pixel areas",
    "edge_rolloff": "the field bends at the sensor's edge",
    "mask_stitch": "periodic error of pixel sizes from the mask",
    "tearing": "the field bends at a boundary between columns",
    "charge_loss": "light is collected the less, the more charge is there",
    "persistence": "charge left from earlier exposures",
    "shutter_timing": "exposure times are offset, or unequal over the sensor",
    "dark_hot": "dark current or hot columns",
    "saturation": "the full well is lower than the card says",
    "fringing": "interference at long wavelengths",
    "psf_wings": "spots have an extended halo",
    "cosmic_rays": "tracks of particles",
    "illumination_turbulence": "the illumination changes from frame to frame",
    "outside_library": "none of the effects that are known here",
}
"""By class word."""
