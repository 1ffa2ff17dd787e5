"""The method, one module a stage, in the order of ``pipeline.reconstruct``.

A stage is a function from the context and the products of earlier stages to ``Staged`` of its own product. It reads no
clock and no global, and of files only the face networks, the cached arrays of a model, and pictures in full size
through ``context.read_original``. A new stage is a module here and its line in ``reconstruct``.
"""
