"""Builds head models (section 3): brings scans into correspondence, trains models, and imports models of other sources.
No stage of a job needs it.

In: raw scans (mm) with landmarks, or models in other formats. Out: a model file's content."""
