"""Measurements on arrays in electrons: flats, spots, corrections, and the toy model of flats."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.measure.correct import correct_edges, correct_kernel
    from bfsensor.measure.covariance_fit import CovarianceFit, fit_covariances
    from bfsensor.measure.covariance_model import model_covariances
    from bfsensor.measure.curve import CovarianceCurve, measure_curve
    from bfsensor.measure.flat_pairs import (
        FlatCovariances,
        flat_covariances,
        measure_regions,
    )
    from bfsensor.measure.growth import Growth, measure_growth
    from bfsensor.measure.pixel_response import measure_response
    from bfsensor.measure.slopes import BFSlope, bf_slopes
    from bfsensor.measure.spot_fit import fit_spots
    from bfsensor.measure.spot_moments import SpotMoments, measure_moments
    from bfsensor.measure.spot_result import SpotFit
    from bfsensor.measure.spots import SpotList, Stamps, cut_stamps, find_spots
    from bfsensor.measure.toy import (
        PairMoments,
        measure_pair,
        predict_pair,
        predict_pair_as_printed,
        throw_at_pair,
    )
    from bfsensor.measure.toy_array import measure_array, predict_array, throw_at_array
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "correct": ["correct_edges", "correct_kernel"],
            "covariance_fit": ["CovarianceFit", "fit_covariances"],
            "covariance_model": ["model_covariances"],
            "curve": ["CovarianceCurve", "measure_curve"],
            "flat_pairs": ["FlatCovariances", "flat_covariances", "measure_regions"],
            "growth": ["Growth", "measure_growth"],
            "pixel_response": ["measure_response"],
            "slopes": ["BFSlope", "bf_slopes"],
            "spot_fit": ["fit_spots"],
            "spot_moments": ["SpotMoments", "measure_moments"],
            "spot_result": ["SpotFit"],
            "spots": ["SpotList", "Stamps", "cut_stamps", "find_spots"],
            "toy": [
                "PairMoments",
                "measure_pair",
                "predict_pair",
                "predict_pair_as_printed",
                "throw_at_pair",
            ],
            "toy_array": ["measure_array", "predict_array", "throw_at_array"],
        },
    )

__all__ = [
    "BFSlope",
    "CovarianceCurve",
    "CovarianceFit",
    "FlatCovariances",
    "Growth",
    "PairMoments",
    "SpotFit",
    "SpotList",
    "SpotMoments",
    "Stamps",
    "bf_slopes",
    "correct_edges",
    "correct_kernel",
    "cut_stamps",
    "find_spots",
    "fit_covariances",
    "fit_spots",
    "flat_covariances",
    "measure_array",
    "measure_curve",
    "measure_growth",
    "measure_moments",
    "measure_pair",
    "measure_regions",
    "measure_response",
    "model_covariances",
    "predict_array",
    "predict_pair",
    "predict_pair_as_printed",
    "throw_at_array",
    "throw_at_pair",
]
