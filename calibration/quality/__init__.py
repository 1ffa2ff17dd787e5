"""Which corners are wrong, and what the operator is told about a calibration."""
