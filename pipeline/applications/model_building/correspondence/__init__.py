"""Brings scans into correspondence (the paper's section 3.2): warps a reference head to landmarks, then fits it to the
surface."""
