"""A diagnosis in words and figures: report.json and report.html."""
