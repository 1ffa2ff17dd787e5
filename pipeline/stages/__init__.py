"""Holds the method, one module for each stage, in the order of ``pipeline.reconstruct``.

A stage is a function from the context and the products of earlier stages to ``Staged`` of its own product. A stage
reads no clock and no global. The only files it reads are the face networks, the cached arrays of a model, and full-size
pictures through ``context.read_original``. A new stage is a module here and a line in ``reconstruct``.
"""
