"""Judges a calibration: finds wrong corners, and writes the operator's messages."""
