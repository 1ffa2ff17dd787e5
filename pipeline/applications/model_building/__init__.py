"""Builds head models (the paper's section 3): brings scans into correspondence, trains models, and imports models of
other sources. Reconstruction jobs do not use this package.

The input is raw scans (mm) with landmarks, or models in other formats. The output is the content of a model file."""
