"""False alarms, power and place of mismatches that the diagnosis detects."""
