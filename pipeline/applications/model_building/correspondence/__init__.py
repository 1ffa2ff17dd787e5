"""Brings scans into correspondence (the paper's section 3.2): warps a reference to landmarks, fits it to surfaces."""
