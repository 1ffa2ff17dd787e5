"""The method, one module a stage, in the order of ``pipeline.reconstruct``.

A stage is a function from the context and the products of earlier stages to ``Staged`` of its own product. It reads no
file, clock or global; the rooms beside this one hold the mathematics that it calls. A new stage is a module here and
its line in ``reconstruct``.
"""
