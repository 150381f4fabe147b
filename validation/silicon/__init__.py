"""Silicon physics that a simulated device lacks, concealed by engines other than the predictor's."""
