"""Brings scans into correspondence (the paper's section 3.2): warps a reference head to each scan's landmarks, then
fits it to the scan's surface."""
