"""Builds head models (section 3): scans in correspondence, training, models of other sources. No stage of a job needs
it.

Enters: raw scans (mm) with landmarks, or models in other formats. Leaves: a model file's content."""
