"""Contains one module for each stage of a reconstruction; ``pipeline.reconstruct`` calls them in order.

A stage is a function of the context and the products of earlier stages; it returns its product as ``Staged``. A stage
reads no clock and no global. A stage reads no files but the face networks, the cached arrays of a model, and full-size
pictures through ``context.read_original``. A new stage needs a module in this folder and a line in ``reconstruct``.
"""
