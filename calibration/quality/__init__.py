"""Finds wrong corners of a calibration, checks the result, and explains both to the operator."""
