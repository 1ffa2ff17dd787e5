"""Brings scans into correspondence (section 3.2): warps the reference to the landmarks, then fits it to each scan."""
