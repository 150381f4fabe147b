"""The direct simulation: electrons one by one, charge fed back into the field."""
