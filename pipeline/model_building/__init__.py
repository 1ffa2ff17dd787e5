"""Builds head models (section 3): scans in correspondence, training, other sources. No stage of a job needs it."""
